"""The driver and its robots: their results, their messages, and how these are counted."""

import numpy as np
import pytest
from budget import examples
from graphs import (
    DIMENSIONS,
    LOUD_NOISE,
    MILD_NOISE,
    SEEDS,
    varied_graph,
)
from hypothesis import example, given, settings, strategies as st
from robots import (
    BACKENDS,
    PARTITIONERS,
    Partitioner,
    Recording,
    arrays_in,
    bytes_of,
    contiguous,
    corner_cases,
    driver_at,
)

from pgo_models import (
    NoiseModel,
    PGOProblem,
    PoseGraph,
    Poses,
    chordal_start,
    grid,
    multipliers,
    partition,
)
from pgo_models.errors import SettingError
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.cholesky import CholeskyBackend
from solvers import InProcess, Pipeline, Robots, Solution, solve
from solvers.place import AUTO, FirstStage
from solvers.robots import newton, poses as pose_orders, soc as substructured
from solvers.robots.driver import collect
from solvers.robots.proof import fits_part, move_proof, prove_interior
from solvers.robots.setup import open_driver

SIZES = st.integers(2, 24)
NOISES = st.sampled_from([MILD_NOISE, LOUD_NOISE])
# orders that are not counted
OFF = ("describe", "set_poses", "cost", "result")

PROOF = (fits_part, prove_interior, move_proof)


def check_start(problem: PGOProblem, parts: Partition) -> None:
    driver = driver_at(problem, parts, None)
    poses, Lambda = collect(driver)
    expected = chordal_start(problem)
    size = 1 + np.abs(expected.t).max()
    np.testing.assert_allclose(poses.R, expected.R, rtol=0, atol=1e-9)
    np.testing.assert_allclose(poses.t - poses.t[0], expected.t, rtol=0, atol=1e-9 * size)
    scale = float(problem.M.diagonal().max())
    np.testing.assert_allclose(
        Lambda, multipliers(problem, poses), rtol=0, atol=1e-12 * scale * size
    )
    assert driver.current.objective == pytest.approx(
        problem.objective(poses), rel=1e-12, abs=1e-24 * scale
    )
    assert driver.network.ledger.rounds == 2


@settings(max_examples=examples(40))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, noise=NOISES, partitioner=PARTITIONERS, backend=BACKENDS)
def test_the_chordal_start_is_the_central_one(
    seed: int, n: int, d: int, noise: NoiseModel, partitioner: Partitioner, backend: CholeskyBackend
) -> None:
    graph = varied_graph(seed, n, d, noise)
    check_start(PGOProblem(graph, backend), partitioner(graph, seed))


@settings(max_examples=examples(20))
@given(seed=SEEDS, n=SIZES, noise=NOISES, partitioner=PARTITIONERS, backend=BACKENDS)
def test_the_averaged_start_is_the_central_one(
    seed: int, n: int, noise: NoiseModel, partitioner: Partitioner, backend: CholeskyBackend
) -> None:
    problem = PGOProblem(varied_graph(seed, n, 2, noise), backend)
    driver = open_driver(problem, partitioner(problem.graph, seed), InProcess())
    assert driver.can_average
    driver.go_to_chordal_start(averaged=True)
    expected = chordal_start(problem, averaged=True)
    found, _ = collect(driver)
    size = 1 + np.abs(expected.t).max()
    np.testing.assert_allclose(found.R, expected.R, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.t - found.t[0], expected.t, rtol=0, atol=1e-9 * size)
    assert driver.network.ledger.rounds == 3


@pytest.mark.parametrize(("graph", "parts"), corner_cases(), ids=str)
def test_the_chordal_start_of_corner_cases(graph: PoseGraph, parts: Partition) -> None:
    check_start(PGOProblem(graph), parts)


def test_robots_of_a_snapshot_return_to_their_own_moments_alone() -> None:
    """The numbers of moments begin anew with a driver: those of the run before mean nothing."""
    problem = PGOProblem(grid(np.random.default_rng(0)))
    robots = partition(problem.graph, 2)
    first, second = (driver_at(problem, robots, None) for _ in range(2))
    start = first.moment()
    first.set_poses(Poses.identity(problem.num_poses, problem.d))
    second.resume(first.state, first.network.ledger, first.snapshots())
    resumed = second.moment()
    assert resumed.number == start.number
    second.go_to_chordal_start()
    second.return_to(resumed)
    np.testing.assert_array_equal(collect(second)[0].R, collect(first)[0].R)


def test_robots_return_to_a_moment_that_nobody_holds_any_more() -> None:
    problem = PGOProblem(grid(np.random.default_rng(0)))
    driver = driver_at(problem, partition(problem.graph, 2), None)
    start = collect(driver)[0]
    moment = driver.moment()
    driver.set_poses(Poses.identity(problem.num_poses, problem.d))
    driver.return_to(moment)
    del moment
    np.testing.assert_array_equal(collect(driver)[0].R, start.R)


def test_separators_that_would_not_fit_are_refused_before_a_robot_starts() -> None:
    graph = grid(np.random.default_rng(0))
    engine = Recording()
    with pytest.raises(SettingError, match="use a METIS partition or fewer robots"):
        solve(graph, robots=Robots(partition(graph, 3), engine=engine, driver_memory=1e3))
    assert engine.shares == ()


# What crosses.


def solved(
    seed: int, n: int, d: int, partitioner: Partitioner, noise: NoiseModel, soc: FirstStage = AUTO
) -> tuple[Solution, Recording]:
    graph = varied_graph(seed, n, d, noise)
    engine = Recording()
    pipeline = Pipeline(soc=soc, staircase=None)
    solution = solve(graph, pipeline, robots=Robots(partitioner(graph, seed), engine=engine))
    assert engine.is_closed
    return solution, engine


@settings(max_examples=examples(25))
@given(seed=SEEDS, n=st.integers(3, 16), d=DIMENSIONS, noise=NOISES, partitioner=PARTITIONERS)
def test_the_ledger_counts_what_was_sent(
    seed: int, n: int, d: int, noise: NoiseModel, partitioner: Partitioner
) -> None:
    solution, engine = solved(seed, n, d, partitioner, noise)
    ledger = solution.ledger
    number = len(engine.shares)
    sent = np.zeros((2, number))
    received = np.zeros((2, number))
    messages = 0
    for order, down, up in engine.log:
        if order in OFF:
            continue
        for robot in range(number):
            for total, message in ((received, down[robot]), (sent, up[robot])):
                size = sum(
                    bytes_of(value)
                    for name, value in arrays_in(message)
                    if not name.startswith("measured")
                )
                total[0, robot] += size
                messages += size > 0
    np.testing.assert_array_equal(ledger.bytes_sent, sent[0])
    np.testing.assert_array_equal(ledger.bytes_received, received[0])
    assert (ledger.num_robots, ledger.messages, ledger.num_bytes) == (
        number,
        messages,
        sent[0].sum() + received[0].sum(),
    )
    # A solve of M x = b, a step (a), a Newton direction, the best translations and a proof take one
    # round each, and so does a move at rounding level, whose translations move straight on.
    counted = (
        *(
            pose_orders.project,
            pose_orders.turn_by,
            pose_orders.set_translations,
            substructured.penalize,
            substructured.rescale,
            substructured.solve,
        ),
        *(substructured.finish, newton.move, newton.evaluate_trial, newton.move_straight, *PROOF),
    )
    assert ledger.rounds == engine.times(*counted)
    assert ledger.all_reduces == engine.times(substructured.agree)
    last = solution.stages[-1].history.records[-1].measurement
    assert last.rounds == ledger.rounds - engine.times(*PROOF)


def test_rounds_of_a_whole_solve_are_as_documented() -> None:
    graph = grid(np.random.default_rng(0))
    solution = solve(graph, robots=partition(graph, 3))
    start, soc, newton = solution.stages
    assert start.name == "chordal start"
    # 2 to start, 1 for the penalty and 1 a step and 2 for the result of SOC, 2 a move of Newton, 2
    # for the proof.
    assert solution.ledger.rounds == 2 + (1 + soc.iterations + 2) + 2 * newton.iterations + 2
    assert solution.ledger.all_reduces == soc.iterations
    rounds = [record.measurement.rounds for record in soc.history.records]
    assert rounds == list(range(3, 4 + soc.iterations))


def lower(g: int, width: int) -> tuple[int]:
    """Shape of the lower triangle of a matrix with `width` unknowns a separator."""
    return (width * g * (width * g + 1) // 2,)


@settings(max_examples=examples(15))
@example(seed=234, n=20, d=3, noise=LOUD_NOISE, partitioner=contiguous)  # terms go back to the best
@given(seed=SEEDS, n=st.integers(6, 24), d=DIMENSIONS, noise=NOISES, partitioner=PARTITIONERS)
def test_no_interior_pose_and_no_private_measurement_crosses(
    seed: int, n: int, d: int, noise: NoiseModel, partitioner: Partitioner
) -> None:
    solution, engine = solved(seed, n, d, partitioner, noise)
    # as the robots hold them
    graph = solution.problem.graph
    poses = solution.certificate.poses
    cover = np.unique(np.concatenate([share.poses[share.is_separator] for share in engine.shares]))
    interior = np.setdiff1d(np.arange(n), cover)
    private = ~np.isin(graph.i, cover) & ~np.isin(graph.j, cover)
    secrets = np.concatenate(
        [
            poses.R[interior].ravel(),
            poses.t[interior].ravel(),
            graph.R_ij[private].ravel(),
            graph.t_ij[private].ravel(),
            graph.kappa[private],
            graph.tau[private],
        ]
    )
    secrets = secrets[~np.isin(np.abs(secrets), [0.0, 1.0])]  # which anything may be
    # ||Lambda_i|| and m_i, for the quantile of the penalty, and the largest diagonal entry of M are
    # sent: of a pose with one edge they are its precision.
    sent = [
        value
        # Robots are given poses where a solve goes back to those of an earlier attempt.
        for name, value in engine.crossed("result", "set_poses")
        if name not in ("norms", "scale")
    ]
    assert not np.isin(secrets, np.concatenate(sent)).any()
