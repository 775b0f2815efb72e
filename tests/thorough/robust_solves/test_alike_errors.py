"""Errors that are larger than claimed on all edges alike, and wrong closures that look like it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel
from solvers.robust.known import odometry
from solvers.robust.rejection import Rejection

CASES = Path(__file__).parents[2] / "cases"


def world(seed: int, claim: float) -> pgo.PoseGraph:
    """A world whose squared errors are `claim` times those claimed."""
    rng = np.random.default_rng(seed)
    noise = NoiseModel(0.05, 0.01)
    n = int(rng.integers(30, 80))
    graph = pgo.grid_world(1, n, rng, d=2, loop_closure_probability=0.6, noise=noise)
    # An error of the angle w adds 2 kappa w^2 to F.
    kappa = np.full(graph.num_edges, 0.5 * claim / noise.rotation_std**2)
    return replace(graph, kappa=kappa, tau=claim * graph.tau, information=None)


def judged(graph: pgo.PoseGraph) -> Rejection:
    robust = solvers.solve(graph, robust=solvers.GNC(), progress=False).robust
    assert robust is not None
    return robust


def test_wrong_closures_under_one_motion_are_no_noise() -> None:
    robust = judged(pgo.read_g2o(CASES / "alike35.g2o"))
    assert np.flatnonzero(robust.rejected).tolist() == [49, 50, 51, 52, 53]


@pytest.mark.parametrize("claim", [16.0, 1e4])
def test_where_all_errors_are_larger_than_claimed_no_edge_is_rejected(claim: float) -> None:
    robust = judged(world(1, claim))
    assert robust.kept.all()
    assert robust.noise == pytest.approx(claim, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 60, 10))
def test_wrong_runs_are_never_taken_for_noise(first: int) -> None:
    for seed in range(first, first + 10):
        graph = world(seed, 1.0)
        closures = np.flatnonzero(~odometry(graph))
        rng = np.random.default_rng(seed)
        num_wrong = int(rng.integers(3, 3 * len(closures) // 4))
        begin = int(rng.integers(0, len(closures) - num_wrong + 1))
        t_ij = graph.t_ij.copy()
        t_ij[closures[begin : begin + num_wrong]] += rng.normal(0.0, 2.0, 2)
        assert judged(replace(graph, t_ij=t_ij)).noise == 1.0, seed
