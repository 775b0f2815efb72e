"""Weights that are too far apart for doubles: the edge to blame, and its line in the file."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel, PoseGraph, Verdict
from pgo_models.graphs.g2o import edge_places
from pgo_models.graphs.pose_graph import isotropic_information
from pgo_models.graphs.precisions import (
    extreme_weight,
)


def weighted(graph: PoseGraph, factors: dict[int, float]) -> PoseGraph:
    """Graph with some edges' weights times a factor."""
    factor = np.ones(graph.num_edges)
    factor[list(factors)] = list(factors.values())
    return graph.with_weights(factor * graph.kappa, factor * graph.tau)


def two_joined(factor: float) -> PoseGraph:
    """Two copies of a scene, joined by one edge whose weights have a factor: its last."""
    one = pgo.grid(np.random.default_rng(0))
    n = one.num_poses
    i = one.i
    j = one.j
    return PoseGraph(
        num_poses=2 * n,
        i=np.concatenate([i, i + n, [0]]),
        j=np.concatenate([j, j + n, [n]]),
        R_ij=np.concatenate([one.R_ij, one.R_ij, one.R_ij[:1]]),
        t_ij=np.concatenate([one.t_ij, one.t_ij, one.t_ij[:1]]),
        kappa=np.concatenate([one.kappa, one.kappa, factor * one.kappa[:1]]),
        tau=np.concatenate([one.tau, one.tau, factor * one.tau[:1]]),
    )


@pytest.mark.parametrize(
    ("graph", "edge"),
    [
        (weighted(pgo.grid(np.random.default_rng(0)), {5: 1e15, 9: 1e-18}), 5),
        (two_joined(1e-12), -1),
    ],
    ids=["heavy", "light"],
)
def test_a_solution_without_a_bound_names_the_weight_that_is_the_cause(
    graph: PoseGraph, edge: int
) -> None:
    solution = solvers.solve(graph)
    assert solution.certificate.verdict is Verdict.TRIVIAL
    assert f"kappa of edge {graph.i[edge]} -> {graph.j[edge]} is" in solution.note
    assert "solve graph.unit_weights()" in solution.note
    assert solution.note in str(solution)


def test_a_weight_is_not_named_where_it_is_not_the_cause() -> None:
    grid = pgo.grid(np.random.default_rng(0))
    assert solvers.solve(weighted(grid, {5: 1e9, 9: 1e-15})).note == ""
    noisy = pgo.random_geometric(40, np.random.default_rng(0), noise=NoiseModel(0.5, 1.0))
    solution = solvers.solve(weighted(noisy, {3: 2e10}))
    assert solution.certificate.verdict is Verdict.NOT_CERTIFIED
    assert "too far from others" not in solution.note


def test_the_place_of_an_edge_is_that_of_its_own_line(tmp_path: Path) -> None:
    graph = pgo.grid(np.random.default_rng(0))
    twice = np.concatenate([np.arange(graph.num_edges), [4, 4]])
    parts = {
        name: getattr(graph, name)[twice] for name in ("i", "j", "R_ij", "t_ij", "kappa", "tau")
    }
    repeated = weighted(replace(graph, **parts, information=None), {-1: 1e15})
    repeated = replace(
        repeated, information=isotropic_information(repeated.kappa, repeated.tau, graph.d)
    )
    path = tmp_path / "repeated.g2o"
    pgo.write_g2o(repeated, path)
    last = len(path.read_text().splitlines())
    assert edge_places(path)[extreme_weight(pgo.read_g2o(path))[1]] == f"{path}:{last}"
