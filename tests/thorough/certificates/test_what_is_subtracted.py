"""What a bound gives up, term by term: nothing of it may be missing."""

import math
from dataclasses import replace

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, varied_graph
from hypothesis import assume, given
from robots import cut_in_one_piece

from pgo_models import (
    PGOProblem,
    PoseGraph,
    Poses,
    certify_at,
    chordal_start,
    multipliers,
    prove_bound,
    random_rotations,
)
from pgo_models.certificates import lower_bound
from pgo_models.certificates.certificate import judge
from pgo_models.certificates.definiteness import FIRST_MARGIN, prove_definite, shifted_certificate
from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.certificates.lower_bound import prove_at
from pgo_models.certificates.rounding_errors import evaluate_certificate, matrix_errors
from pgo_models.errors import ProofError
from solvers import polish
from solvers.robots import proof as proof_by_robots
from solvers.robots.elimination import Cut


def one_edge(kappa: float) -> PGOProblem:
    """Two poses that are measured to be the same."""
    edge = np.array([0]), np.array([1]), np.eye(3)[None], np.zeros((1, 3))
    return PGOProblem(PoseGraph(2, *edge, np.array([kappa]), np.ones(1)))


def optimum(problem: PGOProblem) -> Poses:
    return polish(problem, chordal_start(problem))


@pytest.mark.parametrize("share", [1.001, 1.5, 2.0])
def test_a_shift_costs_what_rotations_half_a_turn_apart_cost(share: float) -> None:
    """At poses half a turn apart F is 8 kappa, which is a maximum; the least F is 0."""
    kappa = 3.0
    problem = one_edge(kappa)
    opposite = Poses(np.stack([np.eye(3), np.diag([-1.0, -1.0, 1.0])]), np.zeros((2, 3)))
    Lambda = multipliers(problem, opposite)
    assert problem.objective(opposite) == pytest.approx(8.0 * kappa)
    bound = prove_bound(problem, Lambda, share * kappa, opposite)
    assert bound is None or bound == 0.0


@given(seed=SEEDS, d=DIMENSIONS)
def test_the_diagonal_of_errors_is_no_smaller_than_what_was_rounded(seed: int, d: int) -> None:
    """M - Lambda is rounded before the shifts are added.

    Either can be far larger than what is stored in the end.
    """
    problem = PGOProblem(varied_graph(seed, 6, d))
    rng = np.random.default_rng(seed)
    positions = problem.diagonal_positions
    of_M = problem.M.data[positions]
    rotations = of_M[problem.num_poses :].reshape(-1, d)
    # Lambda takes nearly all of the diagonal of M, or adds far more than there is.
    for share in (1.0 - 1e-9, -1e6):
        Lambda = share * rotations[:, :, None] * np.eye(d)
        shifts = rng.uniform(0.0, 1.0, problem.side) * of_M
        stored, diagonal = shifted_certificate(problem, Lambda, shifts)
        assert (diagonal >= of_M + shifts).all()
        assert (diagonal >= np.abs(stored.data[positions])).all()
        before = of_M.copy()
        before[problem.num_poses :] -= np.einsum("naa->na", Lambda).ravel()
        assert (diagonal >= np.abs(before) * (1.0 - 1e-12)).all()


@given(seed=SEEDS, d=DIMENSIONS)
def test_a_proof_counts_the_rounding_of_the_entries(seed: int, d: int) -> None:
    problem = PGOProblem(varied_graph(seed, 6, d))
    Lambda = multipliers(problem, optimum(problem))
    fixed = lower_bound.pose_rows(0, 6, d)
    proof = prove_definite(problem, Lambda, 0.0, fixed)
    assume(proof is not None)
    _, diagonal = shifted_certificate(problem, Lambda, np.zeros(problem.side))
    entries = matrix_errors(problem, diagonal)
    assert (entries > 0.0).all()
    assert (proof.slack <= (FIRST_MARGIN - entries) * diagonal).all()


@pytest.mark.parametrize("d", [2, 3])
def test_the_rounding_of_the_value_is_subtracted(d: int) -> None:
    problem = PGOProblem(varied_graph(1, 8, d))
    poses = optimum(problem)
    Lambda = multipliers(problem, poses)
    bound = prove_at(problem, Lambda, poses)
    assert bound is not None
    at_optimum = evaluate_certificate(problem, Lambda, problem.at(poses).X, np.zeros((8, d)))
    assert bound.rounding > 0.5 * at_optimum.value_error > 0.0


@given(seed=SEEDS, d=DIMENSIONS)
def test_the_grounded_pose_is_exactly_at_the_origin(seed: int, d: int) -> None:
    problem = PGOProblem(varied_graph(seed, 6, d))
    rng = np.random.default_rng(seed)
    poses = Poses(random_rotations(6, d, rng), 1e3 * rng.standard_normal((6, d)))
    ground = lower_bound._grounded_at(problem, poses)
    expected = np.concatenate([np.zeros((1, d)), np.eye(d)])
    np.testing.assert_array_equal(ground.X[ground.rows], expected)


SCALES = pytest.mark.parametrize("exponent", [-600, -400, 400, 600])


def scaled_problem(exponent: int) -> PGOProblem:
    graph = varied_graph(2, 8, 3)
    size = 2.0**exponent
    return PGOProblem(replace(graph, kappa=size * graph.kappa, tau=size * graph.tau))


@SCALES
def test_weights_near_the_ends_of_the_doubles_prove_nothing(exponent: int) -> None:
    problem = scaled_problem(exponent)
    Lambda = np.zeros((8, 3, 3))
    poses = Poses(np.broadcast_to(np.eye(3), (8, 3, 3)), np.zeros((8, 3)))
    assert prove_at(problem, Lambda, poses, eta=2.0**exponent) is None
    for at in (None, poses):
        assert prove_bound(problem, Lambda, 2.0**exponent, at) is None


@SCALES
def test_weights_near_the_ends_of_the_doubles_prove_nothing_to_a_robot(exponent: int) -> None:
    problem = scaled_problem(exponent)
    inside = np.arange(problem.side) % 8 >= 2
    cut = cut_in_one_piece(np.flatnonzero(inside), np.flatnonzero(~inside))
    nothing_fixed = np.zeros(0, dtype=np.int64)
    found = proof_by_robots.verify_interior(
        problem, np.zeros((8, 3, 3)), 0.0, cut, nothing_fixed, 1e-12, None
    )
    assert found is None


def robot_of_eight_poses(d: int) -> tuple[PGOProblem, Cut]:
    """A problem of which a robot has six poses in its interior."""
    problem = PGOProblem(varied_graph(7, 8, d))
    is_inside = np.concatenate([np.arange(8) >= 2, np.repeat(np.arange(8) >= 2, d)])
    return problem, cut_in_one_piece(np.flatnonzero(is_inside), np.flatnonzero(~is_inside))


@pytest.mark.parametrize("size", [-1e160, -1e200, math.nan])
def test_multipliers_out_of_range_prove_nothing_to_a_robot(size: float) -> None:
    problem, cut = robot_of_eight_poses(3)
    Lambda = np.zeros((8, 3, 3))
    Lambda[4] = size * np.eye(3)
    nothing_fixed = np.zeros(0, dtype=np.int64)
    assert (
        proof_by_robots.verify_interior(problem, Lambda, 0.0, cut, nothing_fixed, 1e-12, None)
        is None
    )


def test_a_diagonal_that_terms_make_negative_is_rounded_all_the_same() -> None:
    problem, cut = robot_of_eight_poses(3)
    graph = problem.graph
    P = np.tile(1e4 * np.eye(3), (graph.num_edges, 1, 1))
    terms = HandednessTerms.at(optimum(problem), graph.i, graph.j, P)
    less = terms.taken_off(problem)
    _, diagonal = shifted_certificate(less, np.zeros((8, 3, 3)), np.zeros(less.side))
    of_M = less.M.data[less.diagonal_positions]
    assert (of_M[cut.boundary] < 0.0).any()
    _, errors = proof_by_robots._entry_errors(less, diagonal, cut)
    assert (errors >= 4 * 3 * 2.0**-53 * np.abs(of_M[cut.boundary])).all()


def test_a_bound_above_F_is_said_to_be_a_defect() -> None:
    problem = PGOProblem(varied_graph(3, 8, 3))
    poses = optimum(problem)
    certificate = certify_at(problem, poses)
    too_high = replace(certificate.bound, value=1.001 * certificate.objective)
    with pytest.raises(ProofError, match=r"is above F = .* a defect of pgo_models"):
        judge(problem, poses, replace(certificate, bound=too_high))
