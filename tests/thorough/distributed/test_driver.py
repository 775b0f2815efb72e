"""The driver and its robots: their results, their messages, and how these are counted."""

from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from graphs import (
    DIMENSIONS,
    LOUD_NOISE,
    MILD_NOISE,
    SEEDS,
    random_poses,
    varied_graph,
    varied_problem,
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
    eliminate_all,
    metis,
)

from pgo_models import NoiseModel, PGOProblem, PoseGraph, Poses
from pgo_models.certificates.dual_variables import multipliers
from pgo_models.errors import GraphError, SettingError
from pgo_models.geometry.rotations import tangent_dimension
from pgo_models.graphs.partitioning import Partition, partition
from pgo_models.graphs.scenes import grid
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.initialization import chordal_start
from solvers import InProcess, Pipeline, Robots, Solution
from solvers.distributed.driver import collect
from solvers.distributed.robots import current_poses, descent, recursion, start, translations
from solvers.distributed.robots.proof_orders import fits_part, move_proof, prove_interior
from solvers.distributed.robots_of_graph import open_driver
from solvers.pipeline import solve
from solvers.place import AUTO, FirstStage
from solvers.soc.soc import WARM_START
from solvers.soc.subgraph import split_graph

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


def test_no_averaged_start_where_an_edge_has_no_tau() -> None:
    graph = varied_graph(3, 12, 2)
    tau = graph.tau.copy()
    tau[-1] = 0.0
    problem = PGOProblem(replace(graph, tau=tau))
    assert not open_driver(problem, metis(graph, 3), InProcess()).can_average
    in_space = varied_problem(3, 12, 3)
    assert not open_driver(in_space, metis(in_space.graph, 3), InProcess()).can_average


@pytest.mark.parametrize(("graph", "parts"), corner_cases(), ids=str)
def test_the_chordal_start_of_corner_cases(graph: PoseGraph, parts: Partition) -> None:
    check_start(PGOProblem(graph), parts)


@settings(max_examples=examples(30))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_poses_from_elsewhere_are_taken_as_they_are(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    problem = varied_problem(seed, n, d)
    given_poses = random_poses(n, d, seed)
    other = random_poses(n, d, seed + 1)
    driver = driver_at(problem, partitioner(problem.graph, seed), given_poses)
    assert driver.current.objective == pytest.approx(problem.objective(given_poses), rel=1e-12)
    driver.save_poses()
    driver.set_poses(other)
    driver.restore_poses()
    poses, Lambda = collect(driver)
    np.testing.assert_array_equal(poses.R, given_poses.R)
    np.testing.assert_array_equal(poses.t, given_poses.t)
    assert driver.current.objective == pytest.approx(problem.objective(given_poses), rel=1e-12)
    scale = float(problem.M.diagonal().max())
    np.testing.assert_allclose(Lambda, multipliers(problem, poses), rtol=0, atol=1e-11 * scale)
    assert driver.network.ledger.rounds == 0
    with pytest.raises(GraphError, match="give one pose for every pose of the graph"):
        driver.set_poses(Poses(given_poses.R[1:], given_poses.t[1:]))


def test_separators_that_would_not_fit_are_refused_before_a_robot_starts() -> None:
    graph = grid(np.random.default_rng(0))
    engine = Recording()
    with pytest.raises(SettingError, match="use a METIS partition or fewer robots"):
        open_driver(PGOProblem(graph), partition(graph, 3), engine, memory=1e3)
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
    assert ledger is not None
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
            start.project,
            start.turn_by,
            translations.set_translations,
            recursion.penalize,
            recursion.rescale,
            recursion.solve,
        ),
        *(recursion.finish, descent.move, descent.evaluate_trial, descent.move_straight, *PROOF),
    )
    assert ledger.rounds == engine.times(*counted)
    assert ledger.all_reduces == engine.times(recursion.agree)
    last = solution.stages[-1].history.records[-1].measurement
    assert last.rounds == ledger.rounds - engine.times(*PROOF)


def test_rounds_of_a_whole_solve_are_as_documented() -> None:
    graph = grid(np.random.default_rng(0))
    engine = Recording()
    solution = solve(graph, robots=Robots(partition(graph, 3), engine=engine))
    assert solution.ledger is not None
    start, soc, newton = solution.stages
    moves = engine.times(descent.move)
    assert start.name == "chordal start"
    assert engine.times(recursion.rescale, descent.turn) == 0
    assert engine.times(prove_interior) == 1
    assert engine.times(recursion.penalize) == 1  # no refresh
    # 2 to start, 1 for the penalty and 1 a step and 2 for the result of SOC, 2 a move of Newton, 2
    # for the proof.
    assert engine.times(move_proof) == 1
    assert solution.ledger.rounds == 2 + (1 + soc.iterations + 2) + 2 * moves + 2
    assert solution.ledger.all_reduces == soc.iterations
    assert newton.iterations <= moves
    rounds = [record.measurement.rounds for record in soc.history.records]
    assert rounds == list(range(3, 4 + soc.iterations))


def lower(g: int, width: int) -> tuple[int]:
    """Shape of the lower triangle of a matrix with `width` unknowns a separator."""
    return (width * g * (width * g + 1) // 2,)


@pytest.mark.parametrize("noise", [MILD_NOISE, LOUD_NOISE])
@pytest.mark.parametrize(("d", "soc"), [(2, AUTO), (2, WARM_START), (3, AUTO)])
def test_what_crosses_has_the_size_of_the_separators(
    d: int, soc: FirstStage, noise: NoiseModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    eliminate_all(monkeypatch)
    solution, engine = solved(7, 40, d, metis, noise, soc)
    graph = solution.problem.graph
    parts = solution.robots
    tangent = d + tangent_dimension(d)
    assert parts is not None
    memory = 40
    seen = set()
    for share in split_graph(graph, parts):
        part = share.part
        if part is None:
            continue
        g = len(part.boundary)
        inside = len(part.interior)
        assert inside not in (0, g)
        sides = ((1, 1), (1, d), (d, d), (d + 1, d), (tangent, 1))
        any_side = {(width * g, k) for width, k in sides}
        allowed = {
            "schur": {lower(g, 1), lower(g, d), lower(g, d + 1), lower(g, tangent)},
            "diagonal": {(d * g,), ((d + 1) * g,), (tangent * g,)},
            "b": any_side,
            "x": any_side,
            "force": {((d + 1) * g, d)},
            "norms": {(inside,)},
            "measured_at": {(d * g, d)},
            "scale": {(inside,)},
            **{name: {((d + 1) * g,)} for name in ("fixed", "sizes")},
            **{name: {((d + 1) * g, d)} for name in ("point", "product", "error")},
            "coefficients": {(k,) for k in range(memory + 1)},
            "sums": {(k,) for k in range(2 * memory + 2)},
        }
        sums = allowed["sums"]
        values = {  # of orders that take or give one array
            "describe": {((d + 1) * g,)},
            "project": any_side,
            "turn_by": {(g, 1)},
            "set_translations": {(g, d)},
            "evaluate_trial": {(g, d)},
            "solve": any_side | sums,
            "cost": {(d * g, d), ()},
            "finish": {(d * g, d)},
            "agree": {()},
            "move_proof": any_side | {()},
        }
        for order, sent, got in engine.log:
            if order == "result":
                continue
            for record in (sent[share.robot], got[share.robot]):
                for name, value in arrays_in(record):
                    plain = values.get(order, {()}) if name == "value" else {()}
                    assert np.shape(value) in allowed.get(name, plain), (order, name)
                    seen.add(name)
    assert {"schur", "b", "x", "value", "force"} <= seen
    if any(stage.name == "SOC" for stage in solution.stages):
        assert {"sums", "coefficients", "norms", "scale"} <= seen
    else:
        assert solution.stages[0].name == "averaged start"


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
    cover = np.unique(np.concatenate([share.poses[share.in_cover >= 0] for share in engine.shares]))
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
        for name, value in engine.crossed(current_poses.result, current_poses.set_poses)
        if name not in ("norms", "scale")
    ]
    assert not np.isin(secrets, np.concatenate(sent)).any()


@pytest.mark.parametrize("d", [2, 3])
def test_threads_change_no_bit(d: int) -> None:
    graph = varied_graph(3, 30, d)
    first, second = (
        solve(graph, robots=Robots(partition(graph, 4), engine=InProcess(threads)))
        for threads in (1, 3)
    )
    np.testing.assert_array_equal(first.poses.R, second.poses.R)
    np.testing.assert_array_equal(first.poses.t, second.poses.t)
    assert first.lower_bound == second.lower_bound


def test_the_number_of_threads_is_checked() -> None:
    with pytest.raises(SettingError, match="threads must be at least 1, got 0"):
        InProcess(0)
