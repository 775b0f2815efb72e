"""Which information matrices are semidefinite: decided exactly, and never altered in silence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact_arithmetic import exact
from graphs import DIMENSIONS, SEEDS, informed, random_poses
from hypothesis import given, strategies as st

import pgo_models as pgo
import solvers
from pgo_models import PoseGraph, edge_residuals
from pgo_models.errors import GraphError
from pgo_models.graphs.precisions import (
    indefinite_edges,
    is_semidefinite_exactly,
    proper_information,
)
from solvers.robust.consistency import pairwise_consistent

RANKS = st.integers(1, 6)


def with_indefinite(graph: PoseGraph, edges: list[int]) -> PoseGraph:
    """The graph with coupling blocks of some edges far too large."""
    assert graph.information is not None
    information = graph.information.copy()
    d = graph.d
    for e in edges:
        information[e, 0, d] = information[e, d, 0] = 10.0 * np.abs(information[e]).max()
    return replace(graph, information=information)


@given(seed=SEEDS, k=st.integers(2, 6), rank=RANKS)
def test_the_exact_test_sees_a_last_bit(seed: int, k: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    B = rng.integers(-9, 10, (k, rank)).astype(float)
    matrix = 2.0 ** rng.integers(-300, 300) * (B @ B.T)
    assert is_semidefinite_exactly(matrix)
    lower = matrix.copy()
    lower[-1, -1] = np.nextafter(lower[-1, -1], -np.inf)
    # e_k is in the range of B B^T
    is_needed = np.linalg.matrix_rank(B[:-1]) < np.linalg.matrix_rank(B)
    assert is_semidefinite_exactly(lower) == is_needed
    assert is_semidefinite_exactly(-matrix) == (not matrix.any())


@given(seed=SEEDS, d=DIMENSIONS, rank=RANKS, spread=st.sampled_from([0.0, 2.0, 6.0]))
def test_semidefinite_matrices_of_every_rank_and_unit_are_whole(
    seed: int, d: int, rank: int, spread: float
) -> None:
    rng = np.random.default_rng(seed)
    k = 3 * d - 3
    graph = informed(seed, 4, d, coupled=True)
    B = np.exp(spread * rng.standard_normal((1, k, 1))) * rng.standard_normal(
        (graph.num_edges, k, min(rank, k))
    )
    information = B @ np.swapaxes(B, 1, 2)
    information = 0.5 * (information + np.swapaxes(information, 1, 2))
    graph = replace(graph, information=information)
    assert not indefinite_edges(graph).any()
    assert pgo.without_indefinite_coupling(graph) is graph
    for stored, counted in zip(information, proper_information(graph), strict=True):
        assert is_semidefinite_exactly(counted)
        raised = np.array(exact(counted) - exact(stored), dtype=float)
        assert (raised == np.diag(np.diag(raised))).all()
        assert (np.diag(raised) <= 2.0**-44 * np.diag(stored)).all()
        if is_semidefinite_exactly(stored):
            np.testing.assert_array_equal(counted, stored)


@given(seed=SEEDS, d=DIMENSIONS, below=st.sampled_from([1e-12, 1e-6, 1.0]))
def test_eigenvalues_below_rounding_are_seen(seed: int, d: int, below: float) -> None:
    rng = np.random.default_rng(seed)
    k = 3 * d - 3
    graph = informed(seed, 4, d, coupled=True)
    assert graph.information is not None
    B = rng.standard_normal((k, k - 1))
    scale = np.exp(3.0 * rng.standard_normal(k))
    singular = B @ B.T
    lowered = singular - below * np.diag(np.diag(singular))
    information = graph.information.copy()
    information[1] = scale[:, None] * (lowered + lowered.T) * scale
    found = indefinite_edges(replace(graph, information=information))
    assert np.flatnonzero(found).tolist() == [1]


def test_indefinite_matrices_are_refused_by_name_and_count_and_f_stays_as_it_is() -> None:
    graph = informed(0, 8, 3, coupled=True)
    bad = with_indefinite(graph, [2, 4])
    refused = (
        rf"information matrices of 2 of {graph.num_edges} edges are indefinite \(first edge 2 \("
    )
    poses = random_poses(8, 3, 0)
    for ask in (
        lambda: pgo.chi2(bad, poses),
        lambda: pgo.PGOProblem(bad, weighting=pgo.Weighting.INFORMATION).objective(poses),
        lambda: solvers.solve(pgo.PGOProblem(bad, weighting=pgo.Weighting.INFORMATION)),
    ):
        with pytest.raises(GraphError, match=refused):
            ask()
    of_F = solvers.solve(bad, progress=False)
    expected = solvers.solve(
        pgo.PGOProblem(graph, weighting=pgo.Weighting.ISOTROPIC), progress=False
    )
    assert of_F.problem.weighting is pgo.Weighting.ISOTROPIC
    assert (of_F.objective, of_F.lower_bound) == (expected.objective, expected.lower_bound)
    record = of_F.as_json()
    assert (record["chi2"], record["edges_without_coupling"]) == (None, 0)
    assert "chi2" not in str(of_F)
    assert np.isfinite(edge_residuals(bad, poses).overall)
    assert pairwise_consistent(bad).any()


def test_coupling_that_is_left_out_is_remembered_and_said() -> None:
    graph = informed(0, 8, 2, coupled=True, spread=0.3)
    changed = pgo.without_indefinite_coupling(with_indefinite(graph, [2, 4]))
    assert changed.uncoupled is not None
    assert np.flatnonzero(changed.uncoupled).tolist() == [2, 4]
    assert changed.information is not None
    assert not changed.information[[2, 4], :2, 2:].any()
    assert not changed.information[[2, 4], 2:, :2].any()
    others = np.delete(np.arange(graph.num_edges), [2, 4])
    np.testing.assert_array_equal(changed.information[others], graph.information[others])  # type: ignore[index]
    assert not indefinite_edges(changed).any()
    solution = solvers.solve(
        pgo.PGOProblem(changed, weighting=pgo.Weighting.INFORMATION), progress=False
    )
    said = (
        f"coupling blocks of 2 of {graph.num_edges} edges left out, "
        "as their information matrices are indefinite"
    )
    assert solution.note.startswith(said)
    assert said in str(solution)
    assert solution.as_json()["edges_without_coupling"] == 2
    of_F = solvers.solve(pgo.PGOProblem(changed, weighting=pgo.Weighting.ISOTROPIC), progress=False)
    assert "left out" not in of_F.note
    assert "without the coupling blocks of 2 edges" in str(of_F)


def test_edits_of_a_graph_keep_what_was_left_out() -> None:
    graph = informed(0, 8, 2, coupled=True)
    changed = pgo.without_indefinite_coupling(with_indefinite(graph, [2, 4]))
    gone = np.arange(graph.num_edges) == 2

    def left_out(edited: PoseGraph) -> int:
        return 0 if edited.uncoupled is None else int(edited.uncoupled.sum())

    assert changed.without_edges(gone).uncoupled is not None
    assert left_out(changed.without_edges(gone)) == 1
    more = changed.with_edges(
        graph.i[:3], graph.j[:3], pgo.Poses(graph.R_ij[:3], graph.t_ij[:3]), 1.0, 1.0
    )
    assert left_out(more) == 2
    assert left_out(changed.subgraph(np.arange(8))) == 2
    assert left_out(changed.unit_weights()) == 0
    assert left_out(pgo.without_indefinite_coupling(with_indefinite(changed, [5]))) == 3
    with pytest.raises(GraphError, match="uncoupled has shape"):
        replace(changed, uncoupled=np.ones(3, dtype=bool))


def test_a_motion_that_is_not_known_whole_is_consistent_with_others() -> None:
    graph = informed(3, 20, 2, coupled=True)
    rng = np.random.default_rng(0)
    B = rng.standard_normal((graph.num_edges, 3, 2))
    kept = pairwise_consistent(
        replace(graph, information=1e-6 * B @ np.swapaxes(B, 1, 2)), quantile=0.999999
    )
    assert kept.all()
