"""The verifier's quadratic forms touch the cost from below, and its elimination is exact."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from flint import arb, arb_mat, ctx, fmpq
from graphs import DIMENSIONS, SEEDS, informed, random_poses
from hypothesis import given, reject, settings, strategies as st

from pgo_models import PGOError, PGOProblem, Poses, Weighting, chi2, read_g2o, write_g2o
from pgo_models.graphs.precisions import edge_precisions
from pgo_models.verification.balls import first_bad_pivot, is_semidefinite
from pgo_models.verification.costs import (
    QuadraticForm,
    StepFailedError,
    UndecidedError,
    add_edge,
    definite_tau,
    less_tau,
    precisions,
)
from pgo_models.verification.measurements import exact_number, read_graph
from pgo_models.verification.verify import eliminate, exact_rotation


@pytest.fixture(autouse=True)
def many_bits() -> Iterator[None]:
    before = ctx.prec
    ctx.prec = 200
    yield
    ctx.prec = before


def rows_of(poses: Poses) -> dict[int, arb_mat]:
    """X, of the rotations beside those stored."""
    found = {}
    for pose, (R, t) in enumerate(zip(poses.R.tolist(), poses.t.tolist(), strict=True)):
        rotation = exact_rotation(R, pose).transpose()
        found[pose] = arb_mat([[arb(x) for x in t], *rotation.tolist()])
    return found


def value_of(form: QuadraticForm, X: dict[int, arb_mat]) -> arb:
    product = form.product(X)
    return form.constant + sum((X[i].transpose() * product[i]).trace() for i in X)


@given(SEEDS, DIMENSIONS, st.booleans(), st.floats(0.1, 10.0))
@settings(max_examples=examples(30))
def test_the_form_is_the_cost_where_it_was_made_and_nowhere_above_it(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    d: int,
    coupled: bool,
    spread: float,
) -> None:
    path = tmp_path_factory.mktemp("costs") / "graph.g2o"
    write_g2o(informed(seed, 4, d, coupled), path)
    graph = read_g2o(path)
    edges = read_graph(path, False).edges
    here, there = (random_poses(4, d, seed + k, spread) for k in range(2))
    X = rows_of(here)
    Y = rows_of(there)
    for cost, weighting in (("F", Weighting.ISOTROPIC), ("chi2", Weighting.INFORMATION)):
        form = QuadraticForm()
        elsewhere = QuadraticForm()
        at_X = sum((add_edge(form, edge, cost, X) for edge in edges), arb(0))
        at_Y = sum((add_edge(elsewhere, edge, cost, Y) for edge in edges), arb(0))
        assert value_of(form, X).overlaps(at_X)
        assert not value_of(form, Y) > at_Y
        expected = PGOProblem(graph, weighting=weighting).objective(here)
        assert float(at_X) == pytest.approx(expected, rel=1e-9)
        if cost == "F":
            assert value_of(form, Y).overlaps(at_Y)
        else:
            assert float(at_Y) == pytest.approx(chi2(graph, there), rel=1e-9)


@given(SEEDS, DIMENSIONS)
@settings(max_examples=examples(20))
def test_precisions_are_those_of_the_project(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    d: int,
) -> None:
    path = tmp_path_factory.mktemp("costs") / "graph.g2o"
    write_g2o(informed(seed, 4, d, coupled=True), path)
    kappa, tau = edge_precisions(read_g2o(path).information)
    for e, edge in enumerate(read_graph(path, False).edges):
        exact = [float(arb(x)) for x in precisions(edge.triangle, d, False)]
        np.testing.assert_allclose(exact, [kappa[e], tau[e]], rtol=1e-9, atol=0)


def blocks_of(A: np.ndarray, sizes: list[int]) -> dict[int, dict[int, arb_mat]]:
    """Blocks of a matrix that are not zero."""
    ends = np.cumsum([0, *sizes])
    found: dict[int, dict[int, arb_mat]] = {k: {} for k in range(len(sizes))}
    for i in range(len(sizes)):
        for j in range(len(sizes)):
            block = A[ends[i] : ends[i + 1], ends[j] : ends[j + 1]]
            if block.any():
                found[i][j] = arb_mat([[arb(x) for x in row] for row in block.tolist()])
    return found


@given(SEEDS, st.integers(1, 8), st.booleans())
@settings(max_examples=examples(40))
def test_elimination_solves_and_tells_definite_from_indefinite(
    seed: int,
    count: int,
    definite: bool,
) -> None:
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 5, count).tolist()
    side = sum(sizes)
    kept = np.kron(rng.random((count, count)) < 0.4, np.ones((4, 4), bool))
    places = np.concatenate([4 * k + np.arange(size) for k, size in enumerate(sizes)])
    A = np.where(kept[np.ix_(places, places)], rng.standard_normal((side, side)), 0.0)
    A = A @ A.T + np.eye(side)
    if not definite:
        axis = rng.standard_normal(side)
        A -= 2.0 * (axis @ A @ axis) / (axis @ axis) ** 2 * np.outer(axis, axis)
    G = rng.standard_normal((side, 3))
    ends = np.cumsum([0, *sizes])
    parts = {k: G[ends[k] : ends[k + 1]].tolist() for k in range(count)}
    right = {k: arb_mat([[arb(x) for x in row] for row in part]) for k, part in parts.items()}
    if definite:
        found = eliminate(blocks_of(A, sizes), right)
        whole = arb_mat([[arb(x) for x in row] for row in G.tolist()])
        exact = arb_mat([[arb(x) for x in row] for row in A.tolist()]).solve(whole)
        assert found.overlaps(whole.transpose() * exact)
    else:
        with pytest.raises(StepFailedError, match="not positive definite"):
            eliminate(blocks_of(A, sizes), right)


def test_a_pivot_that_may_be_zero_is_not_decided() -> None:
    wide = arb(1e-3, 1.0)
    assert first_bad_pivot([[wide]]) is not None
    with pytest.raises(UndecidedError, match="not known to be positive definite"):
        eliminate({0: {0: arb_mat([[wide]])}}, {0: arb_mat([[arb(1)]])})


@pytest.mark.parametrize("d", [2, 3])
def test_a_matrix_that_makes_no_rotation_is_none(d: int) -> None:
    """Of zeros, and of equal columns, the balls are not numbers, which no comparison decides."""
    reflection = np.diag([-1.0, *np.ones(d - 1)])
    skewed = np.eye(d)
    skewed[0, 1] = 1e-5
    for rows in (np.zeros((d, d)), np.ones((d, d)), reflection, skewed):
        with pytest.raises(StepFailedError, match="R is no rotation"):
            exact_rotation(rows.tolist(), "R")


@given(SEEDS, DIMENSIONS, st.sampled_from([0.5, 1.0 - 2.0**-24, 1.0, 1.5]), st.booleans())
@settings(max_examples=examples(40))
def test_a_tau_that_is_found_leaves_the_matrix_definite(
    seed: int, d: int, share: float, is_singular: bool
) -> None:
    """Whatever share of the largest is asked for: what is found in doubles is checked exactly."""
    rng = np.random.default_rng(seed)
    half = rng.integers(-9, 10, (3 * d - 3, 3 * d - 3 - is_singular))
    rows = [[fmpq(x) for x in row] for row in (half @ half.T).tolist()]
    tau = definite_tau(rows, d, share)
    if tau is not None:
        assert tau > 0
        assert first_bad_pivot(less_tau(rows, tau, d)) is None
    if share > 1.0 or is_singular:
        assert tau is None


@pytest.mark.parametrize("word", ["1", "-1.5e-3", "+.5", "5.", "1E+2", "0.1", "-0"])
def test_numbers_are_what_their_digits_say(word: str) -> None:
    from fractions import Fraction

    found = exact_number(Path("g"), 1, word)
    assert Fraction(int(found.p), int(found.q)) == Fraction(word)


@given(SEEDS, st.integers(2, 6), st.integers(1, 6))
@settings(max_examples=examples(40))
def test_semidefinite_matrices_are_told_to_the_last_digit(seed: int, side: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    half = rng.integers(-9, 10, (side, rank))
    whole = half @ half.T
    rows = [[fmpq(int(x), 7) for x in row] for row in whole.tolist()]
    assert is_semidefinite(rows)
    axis = rng.integers(-9, 10, side)
    rest = whole.astype(object) * 10**40 - np.outer(axis, axis).astype(object)
    needed = bool(axis.any()) and np.linalg.matrix_rank(
        np.column_stack([half, axis])
    ) > np.linalg.matrix_rank(half)
    assert is_semidefinite([[fmpq(int(x)) for x in row] for row in rest.tolist()]) == (not needed)


@given(SEEDS, st.integers(2, 6), st.data())
@settings(max_examples=examples(20))
def test_no_matrix_with_a_zero_on_its_diagonal_and_an_entry_beside_it_is_semidefinite(
    seed: int, side: int, data: st.DataObject
) -> None:
    half = np.random.default_rng(seed).integers(-9, 10, (side, side))
    whole = half @ half.T
    at, beside = data.draw(st.permutations(range(side)))[:2]
    whole[at] = whole[:, at] = 0
    assert is_semidefinite([[fmpq(x) for x in row] for row in whole.tolist()])
    whole[at, beside] = whole[beside, at] = 1
    assert not is_semidefinite([[fmpq(x) for x in row] for row in whole.tolist()])


@given(SEEDS, DIMENSIONS, st.floats(0.1, 3.0))
@settings(max_examples=examples(20))
def test_a_form_of_semidefinite_matrices_is_nowhere_above_their_cost(
    tmp_path_factory: pytest.TempPathFactory, seed: int, d: int, spread: float
) -> None:
    path = tmp_path_factory.mktemp("costs") / "graph.g2o"
    graph = informed(seed, 4, d, coupled=True)
    side = 3 * d - 3
    # Of whole numbers, so that the file has them exactly; one less than their side in rank.
    half = np.random.default_rng(seed).integers(-9, 10, (graph.num_edges, side, side - 1))
    write_g2o(replace(graph, information=(half @ np.swapaxes(half, 1, 2)).astype(float)), path)
    try:
        graph = read_g2o(path)
    except PGOError:  # a block of its own is singular
        reject()
    edges = read_graph(path, False).edges
    here, there = (random_poses(4, d, seed + k, spread) for k in range(2))
    X = rows_of(here)
    Y = rows_of(there)
    form = QuadraticForm()
    elsewhere = QuadraticForm()
    at_X = sum((add_edge(form, edge, "chi2", X) for edge in edges), arb(0))
    at_Y = sum((add_edge(elsewhere, edge, "chi2", Y) for edge in edges), arb(0))
    assert value_of(form, X).overlaps(at_X)
    assert not value_of(form, Y) > at_Y
    assert float(at_Y) == pytest.approx(chi2(graph, there), rel=1e-9)
