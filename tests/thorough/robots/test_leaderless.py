"""CONSENSUS without a driver: the optimum to SOC's tolerance, and no certificate."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS, varied_graph, varied_problem
from hypothesis import example, given, settings, strategies as st
from robots import (
    PARTITIONERS,
    Partitioner,
    Recording,
    arrays_in,
    contiguous,
    metis,
    scattered,
    singletons,
)

from pgo_models import (
    PGOProblem,
    Poses,
    Verdict,
    Weighting,
    chordal_start,
    grid,
    project_to_rotations,
    spanning_tree_start,
)
from pgo_models.errors import GraphError, SettingError
from pgo_models.geometry.rotations import unstack_transposes
from pgo_models.graphs.partitioning import Partition
from solvers import (
    SOC,
    Checkpoint,
    Coupling,
    Faults,
    InProcess,
    PaperSOC,
    Pipeline,
    Robots,
    Status,
    polish,
    run,
    solve,
)
from solvers.carry.ledger import DRIVER
from solvers.result import Record
from solvers.robots.consensus import ConsensusSOC
from solvers.robots.place_without_driver import (
    NO_CERTIFICATE,
    collect_copies,
)
from solvers.robots.setup import open_driver
from solvers.robots.trees import robot_tree, tree_traffic
from solvers.soc.recursion_block import Rotations

TOLERANCE = 1e-6
OFF = ("describe", "set_poses")
ALONE = ("numbers", "force", "schur", "b")  # fields that are sent to a driver only


def alone(parts: Partition, **settings: Any) -> Robots:
    """Robots without a driver."""
    return Robots(parts, driver_memory=0, **settings)


@settings(max_examples=examples(15))
@example(seed=1783819, n=9, d=2, partitioner=singletons)  # 704 iterations
@example(seed=32, n=14, d=3, partitioner=contiguous)
@given(seed=SEEDS, n=st.integers(3, 16), d=DIMENSIONS, partitioner=PARTITIONERS)
def test_robots_alone_find_an_optimum_or_stay_at_their_start_and_claim_nothing(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    graph = varied_graph(seed, n, d)
    parts = partitioner(graph, seed)
    engine = Recording()
    soc = SOC(coupling=Coupling.CONSENSUS, robots=parts, tolerance=TOLERANCE, max_iterations=5000)
    solution = solve(graph, Pipeline(soc=soc), robots=alone(parts, engine=engine))
    problem = solution.problem
    best = problem.objective(polish(problem, solution.poses))
    begun = solution.stages[0].objective
    assert [stage.name for stage in solution.stages] in (
        ["chordal start, by rounds", "SOC"],
        ["spanning tree", "SOC"],
    )
    assert solution.status is Status.CONVERGED
    assert solution.objective == pytest.approx(problem.objective(solution.poses), rel=1e-12)
    assert solution.stages[1].objective == pytest.approx(solution.objective, rel=1e-9)
    assert solution.objective - best <= 100 * TOLERANCE * max(
        1.0, best
    ) or solution.objective == pytest.approx(begun)
    assert solution.lower_bound == 0.0
    if solution.objective > 1e-3:  # not of a tree, whose edges all fit
        assert solution.certificate.verdict is Verdict.TRIVIAL
    assert solution.note.endswith(NO_CERTIFICATE)  # of a tree it says first that it has no cycle
    assert f"note         {solution.note}" in str(solution)
    for order, _, answers in engine.log:
        assert order.startswith("ConsensusRobot.") or order in OFF or order == "begin_copies"
        if order not in OFF:
            assert not any(name in ALONE for answer in answers for name, _ in arrays_in(answer))


@pytest.mark.parametrize("partitioner", [contiguous, metis])
@pytest.mark.parametrize(("seed", "d"), [(0, 2), (1, 3), (8, 3)])
def test_rounds_of_the_relaxation_end_at_the_joint_minimiser(
    seed: int, d: int, partitioner: Partitioner
) -> None:
    problem = varied_problem(seed, 15, d)
    driver = open_driver(problem, partitioner(problem.graph, seed), InProcess(), 0)
    soc = SOC(local_passes=1, tolerance=TOLERANCE, max_iterations=500)
    relaxed = run(ConsensusSOC(soc, has_driver=False, rotations=Rotations.RELAXED), driver)
    assert relaxed.status is Status.CONVERGED
    M = problem.M.toarray()
    n = problem.num_poses
    fixed = np.concatenate([[0], n + np.arange(d)])
    free = np.setdiff1d(np.arange(problem.side), fixed)
    X = np.zeros((problem.side, d))
    X[fixed[1:]] = np.eye(d)
    X[free] = np.linalg.solve(M[np.ix_(free, free)], -M[np.ix_(free, fixed)] @ X[fixed])
    expected = project_to_rotations(unstack_transposes(X[n:]))
    np.testing.assert_allclose(collect_copies(driver).R, expected, rtol=0, atol=1e3 * TOLERANCE)


def test_sums_go_along_a_tree_of_robots_and_nothing_to_a_driver() -> None:
    problem = varied_problem(4, 24, 3)
    parts = scattered(problem.graph, 4)
    solution = solve(
        problem, Pipeline(soc=SOC(robots=parts, max_iterations=0)), robots=alone(parts)
    )
    ledger = solution.ledger
    order, parents = robot_tree(problem, parts)
    # Poses, penalties and forces, three times: of the relaxation, of its translations, and of SOC;
    # one round before the first step of the former two, and one a step.
    assert (
        ledger.rounds
        == len(tree_traffic(problem, parts)) + 2 * 3 + 2 + solution.stages[0].iterations
    )
    assert ledger.all_reduces == 3 * 3 + 2 + solution.stages[0].iterations
    sender, receiver, _, _ = ledger.by_link()
    assert DRIVER not in sender
    assert DRIVER not in receiver
    assert parents[order[0]] == order[0] == 0
    joined = {*zip(parts.robot[problem.graph.i], parts.robot[problem.graph.j], strict=True)}
    for place, robot in enumerate(order[1:].tolist(), start=1):
        assert parents[robot] in order[:place]
        assert {(robot, parents[robot]), (parents[robot], robot)} & joined


def test_given_poses_are_the_start_and_stay_where_nothing_is_better() -> None:
    problem = varied_problem(1, 20, 2)
    parts = metis(problem.graph, 3)
    best = polish(problem, chordal_start(problem))
    solution = solve(
        problem, Pipeline(soc=SOC(robots=parts, max_iterations=2)), best, robots=alone(parts)
    )
    assert solution.stages[0].name == "given start"
    assert solution.objective <= problem.objective(best) * (1 + 1e-12)
    with pytest.raises(GraphError, match="give one pose for every pose"):
        solve(
            problem,
            Pipeline(soc=SOC(robots=parts)),
            Poses(np.eye(2)[None], np.zeros((1, 2))),
            robots=alone(parts),
        )


def test_lost_messages_need_no_driver_either() -> None:
    problem = varied_problem(3, 20, 3)
    parts = metis(problem.graph, 4)
    soc = SOC(robots=parts, tolerance=TOLERANCE)
    robots = alone(parts, faults=Faults(loss=0.2, seed=1))
    solution = solve(problem, Pipeline(soc=soc), robots=robots)
    assert solution.status is Status.CONVERGED
    assert solution.objective == pytest.approx(
        problem.objective(polish(problem, chordal_start(problem))), rel=1e-4
    )
    assert solution.objective < problem.objective(spanning_tree_start(problem.graph))


def test_a_run_without_a_driver_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    problem = varied_problem(3, 20, 3)
    parts = metis(problem.graph, 4)
    file = Checkpoint(tmp_path / "run.ckpt", rounds=3)
    pipeline = Pipeline(soc=SOC(robots=parts, tolerance=TOLERANCE))

    def stop(state: object, record: Record) -> bool:
        return record.k == 8

    whole = solve(problem, pipeline, robots=alone(parts))
    broken = solve(problem, pipeline, robots=alone(parts, checkpoint=file), callback=stop)
    assert broken.status is Status.STOPPED
    resumed = solve(problem, pipeline, robots=alone(parts, checkpoint=file))
    assert resumed.stages[1].iterations == whole.stages[1].iterations
    assert resumed.ledger.rounds == whole.ledger.rounds
    np.testing.assert_allclose(resumed.poses.R, whole.poses.R, rtol=0, atol=1e-9)


def test_the_memory_of_the_driver_is_a_setting_and_the_refusal_says_the_way_out() -> None:
    graph = grid(np.random.default_rng(0))
    parts = metis(graph, 3)
    soc = SOC(robots=parts)
    too_little = (
        r"start, Newton and the certificate, whatever the coupling; "
        r".* set it to 0: CONSENSUS without a driver"
    )
    with pytest.raises(SettingError, match=too_little):
        solve(graph, Pipeline(soc=soc), robots=Robots(parts, driver_memory=1e3))
    assert solve(graph, Pipeline(soc=soc), robots=Robots(parts, driver_memory=1e9)).is_certified
    for other in (None, SOC(), SOC(coupling=Coupling.SUBSTRUCTURED), PaperSOC(robots=parts)):
        with pytest.raises(SettingError, match="without a driver robots run CONSENSUS alone"):
            solve(graph, Pipeline(soc=other), robots=alone(parts))
    for value in (-1.0, np.nan):
        with pytest.raises(SettingError, match="driver_memory must not be negative"):
            Robots(parts, driver_memory=value)


def test_robots_without_owners_are_answered() -> None:
    with pytest.raises(SettingError, match="nobody owns the poses"):
        solve(grid(np.random.default_rng(0)), robots=Robots(engine=InProcess()))
    with pytest.raises(SettingError, match="faults must be"):
        Robots(3, faults=0.2)  # type: ignore[arg-type]


def test_without_a_driver_there_is_no_proof_to_write(tmp_path: Path) -> None:
    graph = grid(np.random.default_rng(0))
    parts = metis(graph, 3)
    solution = solve(graph, Pipeline(soc=SOC(robots=parts)), robots=alone(parts))
    with pytest.raises(SettingError, match="no proof to write: no bound was sought, and that F is"):
        solution.save_proof(tmp_path / "proof.json")
    assert not list(tmp_path.iterdir())


def test_rotations_alone_are_solved_without_a_driver() -> None:
    problem = PGOProblem(grid(np.random.default_rng(0)), weighting=Weighting.ROTATIONS)
    parts = metis(problem.graph, 3)
    solution = solve(problem, Pipeline(soc=SOC(robots=parts)), robots=alone(parts))
    assert solution.objective == pytest.approx(solve(problem).objective, rel=1e-6)
    assert solution.note.endswith(NO_CERTIFICATE)  # of a tree it says first that it has no cycle
