"""R_ij that are rotations to rounding alone: bounds are on F of the R_ij as stored, in 300 bits."""

from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from exact_arithmetic import ExactGraph, exact, largest_share, nearest_rotations
from graphs import DIMENSIONS, SEEDS, exact_graph, varied_graph
from hypothesis import given, settings, strategies as st

from pgo_models import (
    NoiseModel,
    PGOProblem,
    PoseGraph,
    certificate_matrix,
    certify_at,
    chordal_start,
    multipliers,
    prove_bound,
)
from pgo_models.certificates.rounding_errors import matrix_error
from pgo_models.geometry.rotations import orthogonality_error
from pgo_models.problem.cholesky import CholeskyBackend
from solvers import polish

BACKENDS = pytest.mark.parametrize("backend", CholeskyBackend)
AS_STORED = 63.0 * float(np.finfo(float).eps)  # farther from rotations than this they are projected


def slanted(graph: PoseGraph, rng: np.random.Generator) -> PoseGraph:
    """The graph with every R_ij moved off the rotations, in a random direction.

    They are moved as far as is taken as it is.
    """
    off = rng.standard_normal(graph.R_ij.shape)
    off += np.swapaxes(off, 1, 2)  # what is skew would turn it alone
    R_ij = graph.R_ij @ (
        np.eye(graph.d) + 0.4 * AS_STORED * off / np.linalg.norm(off, axis=(1, 2))[:, None, None]
    )
    found = replace(graph, R_ij=R_ij, truth=None)
    np.testing.assert_array_equal(found.R_ij, R_ij)
    return found


@BACKENDS
@settings(max_examples=examples(40))
@given(
    seed=SEEDS, n=st.integers(3, 9), d=DIMENSIONS, noise=st.sampled_from([1e-14, 1e-9, 1e-3, 0.3])
)
def test_the_bound_is_on_F_of_the_rotations_stored(
    backend: CholeskyBackend, seed: int, n: int, d: int, noise: float
) -> None:
    rng = np.random.default_rng(seed)
    graph = slanted(varied_graph(seed, n, d, NoiseModel(noise, noise)), rng)
    assert AS_STORED / 4.0 < orthogonality_error(graph.R_ij).max() <= 64.0 * np.finfo(float).eps
    problem = PGOProblem(graph, backend)
    poses = polish(problem, chordal_start(problem))
    F = ExactGraph.of_doubles(graph).objective_of(poses)
    certificate = certify_at(problem, poses)
    # On a tree, even with repeated edges, F is at its rounding level.
    pairs = {frozenset(pair) for pair in zip(graph.i.tolist(), graph.j.tolist(), strict=True)}
    has_loops = len(pairs) >= graph.num_poses
    assert noise != 1e-3 or not has_loops or certificate.gap <= 1e-6
    Lambda = multipliers(problem, poses)
    for bound in (certificate.lower_bound, prove_bound(problem, Lambda, 1e-3)):
        assert bound is None or bound <= F


def test_the_projected_rotations_are_others() -> None:
    """F of a graph without noise is zero for the rotations nearest to the R_ij.

    It is positive for those stored.
    """
    pattern = exact_graph(0, 8, 3)
    assert pattern.truth is not None
    graph = replace(
        pattern, R_ij=pattern.R_ij * (1.0 + 0.3 * AS_STORED), kappa=np.full(pattern.num_edges, 1e30)
    )
    stored = ExactGraph.of_doubles(graph)
    projected = replace(stored, R_ij=nearest_rotations(graph.R_ij))
    poses = pattern.truth
    assert stored.objective_of(poses) > 2 * projected.objective_of(poses)
    bound = prove_bound(
        PGOProblem(graph), 0.999 * multipliers(PGOProblem(graph), poses), poses=poses
    )
    assert bound is None or bound <= stored.objective_of(poses)


@settings(max_examples=examples(20))
@given(seed=SEEDS, n=st.integers(2, 6), d=DIMENSIONS, share=st.floats(0.5, 1.0))
def test_entries_of_S_of_slanted_rotations_are_within_their_share(
    seed: int, n: int, d: int, share: float
) -> None:
    graph = slanted(varied_graph(seed, n, d), np.random.default_rng(seed))
    graph = replace(graph, tau=1e-9 * graph.tau)  # kappa R_ij R_ij^T is all of the diagonal
    problem = PGOProblem(graph)
    Lambda = share * multipliers(problem, polish(problem, chordal_start(problem)))
    S = ExactGraph.of_doubles(graph).certificate_matrix(Lambda)
    stored = certificate_matrix(problem, Lambda).toarray()
    exact_S = np.array(
        [[row.get(column, 0) for column in range(len(S))] for row in S], dtype=object
    )
    diagonal = np.maximum(problem.M.diagonal(), stored.diagonal())
    for difference in (exact_S - exact(stored), exact(stored) - exact_S):
        assert largest_share(difference, diagonal) <= matrix_error(graph)
