"""A whole solve by driver and robots: its certificate and solution are those of one computer."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from graphs import (
    DIMENSIONS,
    LOUD_NOISE,
    SEEDS,
    best_known,
    rounding_of_objective,
    varied_graph,
    varied_problem,
    wound_ring,
)
from hypothesis import given, settings, strategies as st
from robots import BACKENDS, PARTITIONERS, Partitioner, metis, scattered

from pgo_models import (
    NoiseModel,
    PGOProblem,
    Poses,
    chordal_start,
    grid,
    partition,
    prove_bound,
    read_g2o,
    victoria_park,
)
from pgo_models.errors import GraphError, SettingError
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.cholesky import CholeskyBackend
from solvers import (
    SOC,
    Coupling,
    Faults,
    InProcess,
    Newton,
    Pipeline,
    Robots,
    Solution,
    Status,
    gauss_newton,
    solve,
)
from solvers.place import AUTO
from solvers.result import Record
from solvers.soc.soc import WARM_START

pytestmark = pytest.mark.slow  # solves by robots from end to end

ROOT = Path(__file__).parents[3]
SIZES = st.integers(2, 20)
SHORT = replace(Pipeline().with_newton_alone(Newton()), soc=WARM_START)


# solve(.., robots=..)


def check_equal(distributed: Solution, central: Solution) -> None:
    problem = central.problem
    rounding = rounding_of_objective(problem, central.poses.stacked()) + 1e-12 * central.objective
    assert abs(distributed.objective - central.objective) <= rounding
    rounding += (
        central.certificate.rounding_level
        + central.certificate.bound.rounding
        + distributed.certificate.bound.rounding
    )
    assert abs(distributed.lower_bound - central.lower_bound) <= rounding
    assert distributed.gap == pytest.approx(
        central.gap, abs=2 * rounding / max(central.objective, 1e-300)
    )
    assert distributed.certificate.verdict is central.certificate.verdict
    assert distributed.status is central.status
    assert [stage.name for stage in distributed.stages] == [stage.name for stage in central.stages]
    certificate = distributed.certificate
    if not math.isnan(certificate.eta):  # anyone can check it
        at = certificate.poses if certificate.bound.is_grounded else None
        bound = prove_bound(problem, certificate.Lambda, certificate.eta, at)
        assert bound == pytest.approx(distributed.lower_bound, abs=2 * rounding)


@settings(max_examples=examples(25))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS, backend=BACKENDS)
def test_the_solution_is_the_central_one(
    seed: int, n: int, d: int, partitioner: Partitioner, backend: CholeskyBackend
) -> None:
    problem = PGOProblem(varied_graph(seed, n, d), backend)
    parts = partitioner(problem.graph, seed)
    distributed = solve(problem, SHORT, robots=parts)
    central = solve(problem, SHORT)
    check_equal(distributed, central)
    assert distributed.is_certified
    assert distributed.robots is parts
    assert distributed.ledger.num_robots == parts.num_robots
    assert central.robots is None
    assert central.ledger.messages == 0


@pytest.mark.parametrize(("d", "given_start"), [(2, False), (3, True)])
@pytest.mark.parametrize(
    "pipeline",
    [
        Pipeline(soc=WARM_START),
        Pipeline(soc=None),
        Pipeline(soc=None, newton=gauss_newton()),
        Pipeline(soc=SOC(tolerance=1e-8)),
    ],
    ids=["SOC", "no SOC", "Gauss-Newton", "SOC to the end"],
)
def test_every_pipeline_ends_at_the_central_solution(
    pipeline: Pipeline, d: int, given_start: bool
) -> None:
    problem = varied_problem(3, 25, d)
    start = problem.graph.truth if given_start else None
    central = solve(problem, pipeline, start)
    for partitioner in (metis, scattered):
        distributed = solve(problem, pipeline, start, robots=partitioner(problem.graph, 3))
        check_equal(distributed, central)
        first = distributed.stages[0]
        other = central.stages[0]
        assert first.objective == pytest.approx(other.objective, rel=1e-12)


@settings(max_examples=examples(8))
@given(seed=SEEDS, n=st.integers(4, 10), d=DIMENSIONS, partitioner=PARTITIONERS)
def test_a_bound_holds_where_nothing_is_certified(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    problem = PGOProblem(
        varied_graph(seed, n, d, NoiseModel(translation_std=1.0, rotation_std=1.5))
    )
    solution = solve(problem, SHORT, robots=partitioner(problem.graph, seed))
    assert 0 <= solution.lower_bound <= best_known(problem, seed)
    assert solution.objective == pytest.approx(problem.objective(solution.poses), rel=1e-12)


@pytest.mark.parametrize("d", [2, 3])
def test_other_starts_and_the_staircase_follow_where_the_gap_stays_wide(d: int) -> None:
    # The cycle closes with half a turn too much: the chordal start is at a local minimum or the
    # relaxation is loose.
    problem = PGOProblem(varied_graph(11, 14, d, NoiseModel(translation_std=1.0, rotation_std=1.5)))
    solution = solve(problem, robots=3)
    in_one_place = AUTO if d == 2 else WARM_START
    central = solve(problem, Pipeline(soc=in_one_place))
    names = [stage.name.replace(", in one place", "") for stage in solution.stages]
    if d == 3:
        assert names == [stage.name for stage in central.stages]
    else:  # one place finds the bound at the poses, robots by a relaxation in one place
        assert names[-1] == "ComplexRelaxation"
        assert solution.is_certified
        assert central.is_certified
    assert solution.lower_bound <= min(solution.objective, central.objective)
    assert solution.gap == pytest.approx(central.gap, abs=1e-4)


def test_a_number_of_robots_stands_for_the_default_partition() -> None:
    graph = grid(np.random.default_rng(0))
    solution = solve(graph, robots=4)
    assert solution.robots is not None
    np.testing.assert_array_equal(solution.robots.robot, partition(graph, 4).robot)
    with pytest.raises(SettingError, match="num_robots is 28; give 1 to 27"):
        solve(graph, robots=28)


@pytest.mark.parametrize("robots", [None, 3])
def test_the_staircase_is_watched_wherever_it_runs(robots: int | None) -> None:
    (problem, wound), seen = wound_ring(20, 2), list[str]()
    short = Pipeline(soc=None, other_starts=False, handedness=None)
    solve(
        problem,
        short,
        wound,
        robots=robots,
        callback=lambda state, _: seen.append(type(state).__name__),
    )
    assert {name for name in seen if "Staircase" in name}


def test_an_anchor_is_a_pose() -> None:
    graph = victoria_park(np.random.default_rng(0), num_poses=30)
    for anchor, said in (
        (1.5, "whole number"),
        (True, "whole number"),
        (int(graph.landmarks[0]), "a landmark"),
    ):
        with pytest.raises(SettingError, match=said):
            solve(graph, anchor=anchor)


def test_a_start_or_a_partition_of_another_graph_is_refused() -> None:
    graph = grid(np.random.default_rng(0))
    with pytest.raises(GraphError, match="give one pose for every pose"):
        solve(graph, start=Poses(np.eye(3)[None], np.zeros((1, 3))), robots=3)
    with pytest.raises(SettingError, match="give one robot for every pose"):
        solve(graph, robots=Partition(np.array([0, 1]), partition(graph, 3).method))


def stop_at(k: int) -> Callable[[object, Record], bool]:
    return lambda state, record: record.k == k


def interrupt(state: object, record: Record) -> None:
    if record.k == 2:
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("callback", "time_limit", "expected"),
    [
        (stop_at(1), math.inf, [Status.STOPPED, Status.STOPPED]),
        (stop_at(0), math.inf, [Status.STOPPED, Status.STOPPED]),
        (interrupt, math.inf, [Status.INTERRUPTED]),
        (None, 1e-9, [Status.TIME_LIMIT]),
    ],
)
def test_a_run_that_is_cut_short_gives_poses_and_a_bound_that_holds(
    callback: Callable[[object, Record], bool | None] | None,
    time_limit: float,
    expected: list[Status],
) -> None:
    problem = varied_problem(6, 25, 3, LOUD_NOISE)
    parts = metis(problem.graph, 4)
    solution = solve(problem, SHORT, robots=parts, callback=callback, time_limit=time_limit)
    statuses = [stage.status for stage in solution.stages[1:]]
    assert statuses == expected
    assert solution.status is statuses[-1]
    assert solution.objective <= problem.objective(chordal_start(problem)) * (1 + 1e-12)
    assert solution.objective == pytest.approx(problem.objective(solution.poses), rel=1e-12)
    assert solution.lower_bound <= best_known(problem)
    assert solution.ledger.rounds >= 3


STAGES = {
    "substructured": (SOC(coupling=Coupling.SUBSTRUCTURED, max_iterations=4), None),
    "consensus": (SOC(max_iterations=4), None),
    "consensus, loss": (SOC(max_iterations=9), Faults(loss=0.3, seed=1)),
    "consensus, delay": (SOC(max_iterations=9), Faults(max_delay=4, seed=2)),
    "consensus, silence": (
        SOC(max_iterations=9),
        Faults(silent_robot=1, silent_from=2, silent_rounds=9),
    ),
}


@pytest.mark.parametrize(("d", "threads"), [(2, 1), (3, 2)])
@pytest.mark.parametrize("stage", STAGES)
def test_every_stage_reports_f_of_its_poses(stage: str, d: int, threads: int) -> None:
    # Each run ends after one more stage, so that the poses are those of its last one.
    problem = varied_problem(3, 15, d, LOUD_NOISE)
    parts = scattered(problem.graph, 3)
    soc, faults = STAGES[stage]
    if soc.coupling is None:
        soc = replace(soc, coupling=Coupling.CONSENSUS, robots=parts)
    stay = Newton(max_iterations=0)
    for start in (None, problem.graph.truth):
        for pipeline in (
            Pipeline(soc=None, newton=stay),
            *(Pipeline(soc=soc, newton=newton) for newton in (stay, Newton())),
        ):
            short = replace(pipeline, other_starts=False, staircase=None, handedness=None)
            robots = Robots(parts, InProcess(threads), faults=faults if pipeline.soc else None)
            solution = solve(problem, short, start, robots=robots)
            rounding = 1e-12 * solution.objective
            assert solution.objective == pytest.approx(
                problem.objective(solution.poses), abs=rounding
            )
            assert solution.stages[-1].objective == pytest.approx(solution.objective, abs=rounding)
            if pipeline.newton is stay:
                assert solution.stages[-2].objective == pytest.approx(
                    solution.objective, abs=rounding
                )


# Folders with one file a robot.


def check_folder(folder: Path) -> None:
    graph = read_g2o(folder)
    assert graph.num_robots == len(list(folder.glob("*.g2o")))
    parts = partition(graph)
    np.testing.assert_array_equal(parts.robot, graph.robots)
    solution = solve(graph, robots=parts)
    assert solution.is_certified
    assert solution.ledger.num_robots == graph.num_robots
    check_equal(solution, solve(graph, Pipeline(soc=WARM_START)))


def test_the_folder_of_robots_that_comes_along_solves_and_certifies() -> None:
    check_folder(ROOT / "data" / "robots")


@pytest.mark.parametrize("name", ["example_4robots", "example_16robots"])
def test_public_folders_of_robots_solve_and_certify(name: str, benchmark_data: Path) -> None:
    check_folder(benchmark_data / name)
