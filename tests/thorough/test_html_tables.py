from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models.html_tables import facts_table, rows_table

NASTY = "<b>&\"'</td>"


def cells(html):
    return [
        "".join(cell.itertext())
        for cell in ElementTree.fromstring(f"<div>{html}</div>").iter()
        if cell.tag in "tdth"
    ]


def test_tables_are_well_formed_and_escaped():
    assert cells(facts_table([(NASTY, NASTY), ("F", "1")])) == [NASTY, NASTY, "F", "1"]
    assert cells(rows_table([NASTY, "F"], [[NASTY, "1"], ["b", "2"]])) == [
        NASTY,
        "F",
        NASTY,
        "1",
        "b",
        "2",
    ]


@pytest.mark.parametrize("d", [2, 3])
def test_a_graph_shows_what_it_is_made_of(d):
    graph = replace(pgo.grid_world(2, 8, np.random.default_rng(0), d=d), name=NASTY)
    shown = cells(graph._repr_html_())
    facts = dict(zip(shown[::2], shown[1::2], strict=True))
    assert facts["graph"] == f"{NASTY}, {d}D"
    assert (facts["poses"], facts["edges"]) == (str(graph.num_poses), str(graph.num_edges))
    assert (facts["robots"], facts["components"], facts["truth"]) == ("2", "1", "with the graph")


def test_a_certificate_shows_the_same_as_it_prints():
    problem = pgo.PGOProblem(pgo.circle(np.random.default_rng(0)))
    certificate = solvers.certify(problem, problem.graph.truth)
    shown = cells(certificate._repr_html_())
    assert [
        f"{label:<12} {text}" for label, text in zip(shown[::2], shown[1::2], strict=True)
    ] == str(certificate).splitlines()
    assert "best known F" in shown
    assert len(repr(certificate)) < 100
