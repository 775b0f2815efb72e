"""Poses that an optimiser leaves close to measurements without noise are EXACT to a billionth.

And no others: neither those further off, nor those whose errors count beside the stated noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from exact_arithmetic import exact
from graphs import DIMENSIONS, SEEDS, exact_graph
from hypothesis import given, settings, strategies as st

import pgo_models as pgo
import solvers
from pgo_models import PGOProblem, PoseGraph, Poses, Verdict, exp_map


def off_by(graph: PoseGraph, size: float, seed: int) -> Poses:
    """The true poses, moved and turned by errors of about this size, in metres and radians."""
    truth = graph.truth
    assert truth is not None
    rng = np.random.default_rng(seed)
    turn = exp_map(size * rng.standard_normal((graph.num_poses, 1 if graph.d == 2 else 3)))
    return Poses(truth.R @ turn, truth.t + size * rng.standard_normal(truth.t.shape))


@settings(max_examples=examples(25))
@given(
    seed=SEEDS,
    n=st.integers(3, 20),
    d=DIMENSIONS,
    size=st.sampled_from([1e-12, 1e-10, 1e-9, 1e-8, 1e-6]),
    weight=st.sampled_from([1e-9, 1.0, 1e6]),
)
def test_what_the_verdict_says_of_every_edge_holds_in_exact_arithmetic(
    seed: int, n: int, d: int, size: float, weight: float
) -> None:
    graph = exact_graph(seed, n, d)
    graph = graph.with_weights(weight * graph.kappa, weight * graph.tau)
    poses = off_by(graph, size, seed)
    certificate = pgo.certify_at(PGOProblem(graph), poses)
    lengths = np.linalg.norm(graph.t_ij, axis=1)
    residuals_t = poses.t[graph.j] - poses.t[graph.i]
    residuals_t = residuals_t - np.einsum("mab,mb->ma", poses.R[graph.i], graph.t_ij)
    residuals_R = poses.R[graph.j] - poses.R[graph.i] @ graph.R_ij
    norms_t = np.linalg.norm(residuals_t, axis=1)
    norms_R = np.linalg.norm(residuals_R, axis=(1, 2))
    fits = (norms_t <= 1e-9 * lengths).all() and (norms_R <= 1e-9).all()
    if certificate.fit.is_exact and not certificate.fit.is_to_rounding:
        assert certificate.verdict is Verdict.EXACT
        assert fits
        assert exact(certificate.objective_at_most) <= exact(1.001e-12)
        assert certificate.fit.share <= 1e-9
    elif not certificate.fit.is_exact:
        far = norms_t > 0.9e-9 * lengths
        assert far.any() or (norms_R > 0.9e-9).any() or certificate.objective > 0.9e-12


@pytest.mark.parametrize("d", [2, 3])
def test_the_answer_of_an_optimiser_is_exact_and_a_worse_one_is_not(d: int) -> None:
    graph = exact_graph(3, 12, d)
    problem = PGOProblem(graph)
    near = solvers.certify(problem, off_by(graph, 1e-11, 1))
    assert near.verdict is Verdict.EXACT
    assert 1e-13 < near.fit.share <= 1e-9
    assert not solvers.certify(problem, off_by(graph, 1e-6, 1)).fit.is_exact


def test_errors_that_count_beside_the_stated_noise_are_not_exact() -> None:
    graph = exact_graph(3, 12, 3)
    poses = off_by(graph, 1e-11, 1)
    precise = graph.with_weights(1e14 * graph.kappa, 1e14 * graph.tau)
    assert not pgo.certify_at(PGOProblem(precise), poses).fit.is_exact


def test_solve_goes_on_to_the_last_bits() -> None:
    graph = exact_graph(3, 12, 3)
    start = replace(graph, initial=off_by(graph, 1e-11, 1))
    assert solvers.solve(start).certificate.fit.is_to_rounding
