from dataclasses import replace

import pytest
from graphs import REFERENCE

import pgo_models as pgo
from pgo_models.graphs.published_results import published_run


@pytest.mark.parametrize("name", ["circle", "grid", "sphere"])
def test_the_papers_scenes_have_their_row(name):
    row = REFERENCE["paper_tables"][name]
    found = published_run(pgo.load(name))
    assert (found.objective, found.optimum, found.iterations) == (
        row["F_soc"],
        row["F_star"],
        row["iterations_soc"],
    )
    assert 0 < found.gap < 1


@pytest.mark.parametrize("name", ["robots", "source", "note"])
def test_other_names_have_none(name):
    assert published_run(replace(pgo.load("robots"), name=name)) is None


def test_another_graph_of_the_same_name_has_none():
    assert published_run(replace(pgo.load("grid"), name="circle")) is None
