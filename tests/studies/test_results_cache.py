import json
from dataclasses import replace

import numpy as np
import pytest
from graphs import SEEDS, varied_graph
from hypothesis import given

from pgo_models.errors import FileFormatError
from solvers.studies import results_cache as kept_results
from solvers.studies.results_cache import KeptResults, graph_fingerprint


def test_what_is_added_is_there_for_the_next_one(tmp_path):
    path = tmp_path / "kept.json"
    first = KeptResults(path)
    first.add("a", {"objective": 0.1 + 0.2, "iterations": [3, 1]})
    first.add("b", {"rounds": None})
    second = KeptResults(path)
    assert len(second) == 2
    assert second.get("a") == {"objective": 0.1 + 0.2, "iterations": [3, 1]}
    assert second.get("b") == {"rounds": None}
    assert second.get("c") is None
    assert list(tmp_path.iterdir()) == [path]


def test_a_fresh_job_leaves_the_old_results_aside_and_then_replaces_them(tmp_path):
    path = tmp_path / "kept.json"
    KeptResults(path).add("a", {"x": 1})
    fresh = KeptResults(path, is_fresh=True)
    assert fresh.get("a") is None
    fresh.add("b", {"x": 2})
    assert (KeptResults(path).get("a"), KeptResults(path).get("b")) == (None, {"x": 2})


def test_results_of_other_versions_are_not_taken_up(tmp_path, monkeypatch):
    path = tmp_path / "kept.json"
    KeptResults(path).add("a", {"x": 1})
    monkeypatch.setattr(kept_results, "installed_versions", lambda backend: {"numpy": "0.1"})
    assert KeptResults(path).get("a") is None


def test_without_a_file_results_are_kept_for_the_job_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kept = KeptResults(None)
    kept.add("a", {"x": 1})
    assert kept.get("a") == {"x": 1}
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"kind": "else"}', json.dumps({"results": {}})])
def test_a_file_of_something_else_is_never_written_over(text, tmp_path):
    path = tmp_path / "own.json"
    path.write_text(text)
    for is_fresh in (False, True):
        with pytest.raises(FileFormatError, match="remove it or name another file"):
            KeptResults(path, is_fresh)
    assert path.read_text() == text


def test_results_that_are_no_entries_are_refused(tmp_path):
    path = tmp_path / "own.json"
    KeptResults(path).add("a", {"x": 1})
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "results": [1, 2]}))
    with pytest.raises(FileFormatError, match="no results of pgo"):
        KeptResults(path)


@given(SEEDS)
def test_the_fingerprint_is_that_of_the_measurements(seed):
    graph = varied_graph(seed, 6, 3)
    before = graph_fingerprint(graph)
    assert before == graph_fingerprint(varied_graph(seed, 6, 3))
    t_ij = graph.t_ij.copy()
    t_ij[0, 0] = np.nextafter(t_ij[0, 0], np.inf)
    assert before != graph_fingerprint(replace(graph, t_ij=t_ij))
