"""The digits of a file tell the format that wrote it, and the errors of its measurements."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from hypothesis import given, settings, strategies as st
from written import written_text

import pgo_models as pgo
from pgo_models.errors import GraphError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.jrl import read_jrl
from pgo_models.graphs.written_digits import (
    digits_of,
)

ROUNDING_FORMATS = [f"%.{digits}{kind}" for digits in (8, 9, 10, 12) for kind in "fg"]


def printed(numbers: Array, form: str) -> Array:
    """Numbers as they are read from a file that was written with this format."""
    return np.array([float(form % number) for number in numbers])


@settings(max_examples=examples(40))
@given(
    seed=st.integers(0, 2**32 - 1),
    form=st.sampled_from(ROUNDING_FORMATS),
    size=st.sampled_from([1.0, 10.0, 1e3]),
    short=st.lists(st.sampled_from([0.0, 1.0, -1.0, 0.5, 2.25]), max_size=20),
)
def test_half_a_unit_of_the_last_digit_is_what_writing_a_number_changes(
    seed: int, form: str, size: float, short: list[float]
) -> None:
    meant = np.append(size * np.random.default_rng(seed).standard_normal(2000), short)
    read = printed(meant, form)
    digits = digits_of(read)
    assert digits.are_of_format
    changed = np.abs(read - meant)[:2000]
    half = 0.5 * digits.units(read)[:2000]
    assert (changed <= (1.0 + 1e-9) * half + 2.0**-52 * np.abs(read[:2000])).all()
    # Numbers with the most digits are off by half a unit, and nothing more is allowed.
    assert (changed > 0.9 * half).any()


@pytest.mark.parametrize("form", ["%.2f", "%.6f", "%.3g", "%.6g", "%.16g", "%.17g"])
def test_few_digits_and_those_of_doubles_say_nothing(form: str) -> None:
    numbers = np.random.default_rng(0).standard_normal(2000)
    assert not digits_of(printed(numbers, form)).are_of_format


@pytest.mark.parametrize("d", [2, 3])
def test_errors_of_measurements_bound_what_writing_them_changes(d: int, tmp_path: Path) -> None:
    graph = pgo.random_geometric(30, np.random.default_rng(d), d=d)
    path = tmp_path / "graph.g2o"
    for form in ROUNDING_FORMATS:
        path.write_text(written_text(graph, form))
        read = pgo.read_g2o(path)
        assert read.written_error is not None
        of_t = np.linalg.norm(read.t_ij - graph.t_ij, axis=1)
        of_R = np.linalg.norm(read.R_ij - graph.R_ij, axis=(1, 2))
        rounding = 1e-15 * np.linalg.norm(graph.t_ij, axis=1) + 1e-15
        assert (of_t <= read.written_error[:, 0] + rounding).all()
        assert (of_R <= read.written_error[:, 1] + rounding).all()
        assert (of_t > 0.5 * read.written_error[:, 0]).any()
        assert (of_R > 0.3 * read.written_error[:, 1]).any()


def test_errors_go_with_the_edges() -> None:
    graph = pgo.grid(np.random.default_rng(0))
    m = graph.num_edges
    written = np.arange(2.0 * m).reshape(m, 2)
    read = replace(graph, written_error=written)
    part = read.subgraph(np.arange(9))
    kept = (graph.i < 9) & (graph.j < 9)
    np.testing.assert_array_equal(part.written_error, written[kept])
    chosen = np.array([5, 2])
    np.testing.assert_array_equal(read.edge_subgraph(chosen).written_error, written[chosen])
    left = read.without_edges(np.arange(m) == 3)
    np.testing.assert_array_equal(left.written_error, np.delete(written, 3, axis=0))
    # What is measured otherwise has no digits of a file.
    more = read.with_prior(np.array([4]), pgo.Poses.identity(1, 3), 1.0, 1.0)
    np.testing.assert_array_equal(more.written_error, np.append(written, [[0.0, 0.0]], axis=0))
    assert graph.with_prior(np.array([4]), pgo.Poses.identity(1, 3), 1.0, 1.0).written_error is None
    with pytest.raises(GraphError, match="written_error has shape"):
        replace(graph, written_error=written[1:])
    with pytest.raises(GraphError, match="written_error of edge 0"):
        replace(graph, written_error=np.full((m, 2), np.nan))


def test_a_folder_is_written_with_the_digits_of_its_files_together(tmp_path: Path) -> None:
    edge = "EDGE_SE2 {} {} 1 0 {} 1 0 0 1 0 1\n"
    (tmp_path / "0.g2o").write_text(edge.format(0, 1, "0") + edge.format(1, 2, "1"))
    (tmp_path / "1.g2o").write_text(edge.format(2, 3, "1.570796327"))
    read = pgo.read_g2o(tmp_path)
    assert read.written_error is not None
    np.testing.assert_allclose(read.written_error, 0.5e-9 * 2**0.5, rtol=1e-9)


def test_all_tags_of_a_file_count(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(
        "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
        "EDGE_SE2_XY 0 7 1.5 0.123456789 1 0 1\n"
        "EDGE_PRIOR_SE2_XY 1 2.123456789 3 1 0 1\nEDGE_PRIOR_SE2_XY 0 1 3 1 0 1\n"
    )
    read = pgo.read_g2o(path)
    assert read.written_error is not None
    np.testing.assert_allclose(read.written_error[:, 0], 0.5e-9 * 2**0.5, rtol=1e-9)


def test_digits_of_the_estimate_and_of_the_matrices_do_not_count(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(
        "VERTEX_SE2 0 0.123456789 0 0\nVERTEX_SE2 1 1 0 0\n"
        "EDGE_SE2 0 1 1 0 0 1.123456789 0 0 1 0 1\n"
    )
    assert pgo.read_g2o(path).written_error is None


def test_files_in_json_have_digits(tmp_path: Path) -> None:
    pose = {"type": "Pose2", "x": 1.0, "y": 0.5, "theta": 1.570796327}
    between = {
        "type": "BetweenFactorPose2",
        "key1": 0,
        "key2": 1,
        "measurement": pose,
        "covariance": [0.1, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.01],
    }
    measurements = {"a": [{"measurements": [between]}]}
    path = tmp_path / "two.jrl"
    path.write_text(json.dumps({"name": "two", "robots": ["a"], "measurements": measurements}))
    read = read_jrl(path)
    assert read.written_error is not None
    np.testing.assert_allclose(read.written_error, 0.5e-9 * 2**0.5, rtol=1e-9)
