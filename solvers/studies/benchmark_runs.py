"""Runs of the methods to compare; `solvers.studies.benchmark` has the records of their results."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from pgo_models.errors import PGOError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import PartitionMethod, partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.problem import PGOProblem
from solvers.baselines.gauss_seidel import DGSStage, GaussSeidel, GaussSeidelState
from solvers.baselines.gtsam import run_gtsam
from solvers.baselines.sweep_order import schedule
from solvers.carry.ledger import Ledger
from solvers.loop import Solver, run
from solvers.pipeline import solve
from solvers.request import Pipeline
from solvers.result import OUT_OF_TIME, History, Record, Run, Status
from solvers.riemannian.newton import Newton, gauss_newton
from solvers.riemannian.staircase import Staircase
from solvers.soc.paper import PaperSOC, PaperState
from solvers.soc.penalty import BalancedPenalty
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC, WARM_START
from solvers.solution import Solution
from solvers.studies.benchmark import BenchmarkMethod, BenchmarkRun, BenchmarkSettings, StageRecord

# Errors of a method on a graph for which it is not made; any other error is a defect.
FAILURES = (PGOError, np.linalg.LinAlgError, MemoryError)
Callback = Callable[[Any, Record], None]
StageRecords = tuple[StageRecord, ...]
# Limits of runs without a budget of rounds, far beyond those that converge.
_MOST_SWEEPS = 20_000
_MOST_PAPER_ITERATIONS = 5_000
_SECOND_STAGE_TOLERANCE = 1e-6  # relative decrement, below which Gauss-Newton converges slowly
# Initial rho_i / m_i of PAPER, of which the paper says nothing. Of 0.3, 1 and 3, tried on draws 100
# to 109 of its scenes, 0.3 makes the early iterates move far away; 1 and 3 do equally well.
_PAPER_SCALE = 1.0
# Fraction of the rounds of PAPER that its first stage may take. An early step of Gauss-Newton takes
# up to seven rounds.
_FIRST_STAGE_SHARE = 0.5


def run_benchmark(
    method: BenchmarkMethod,
    problem: PGOProblem,
    settings: BenchmarkSettings | None = None,
    start: Poses | None = None,
) -> BenchmarkRun:
    """Run a contender on a graph from its start to its end.

    The couplings of SOC are followed by Newton as in `solve`, PAPER by Gauss-Newton. The second
    stage of PAPER, and all of CONSENSUS and SUBSTRUCTURED, are run by robots and a driver, whose
    ledger counts. An iteration of PAPER is one round between neighbours; one more round, whose
    bytes are not counted, gives the translations. The second stage begins at the last iterate of
    the first, whatever F is there. All contenders but GAUSS_SEIDEL take the given start, or compute
    their own.

    Raises a PGOError if the method cannot be run on this graph, and a KeyboardInterrupt after
    Ctrl-C, since half a run is no result.
    """
    settings = settings if settings is not None else BenchmarkSettings()
    result = _RUNS[method](problem, _Budget(settings, problem.graph), start)
    out_of_time = [stage.status for stage in result.stages if stage.status in OUT_OF_TIME]
    status = out_of_time[0] if out_of_time else result.status
    remarks = [result.remark] if result.remark else []
    # With a limit on its rounds the first stage of PAPER is not expected to converge.
    is_limited = method is BenchmarkMethod.PAPER and settings.max_rounds is not None
    if not is_limited:
        for stage in result.stages[:-1]:
            if not stage.status.is_success:
                remarks.append(f"{stage.name}: {stage.status.name}")
    if not remarks and not status.is_success:
        remarks = [status.name]
    return replace(result, contender=method, status=status, remark="; ".join(remarks))


def reason_of(error: BaseException) -> str:
    """Reason for which a method failed."""
    return str(error) or type(error).__name__


def solve_whole(problem: PGOProblem | PoseGraph, *args: Any, **settings: Any) -> Solution:  # noqa: ANN401 - those of `solve`
    """Return the solution of `solve`, without a bar.

    Raises a KeyboardInterrupt after Ctrl-C, since half a solve is no result.
    """
    solution = solve(problem, *args, **settings, progress=False)
    if any(stage.status is Status.INTERRUPTED for stage in solution.stages):
        raise KeyboardInterrupt
    return solution


class _Budget:
    """Settings and robots of a run, and the time that it has left."""

    def __init__(self, settings: BenchmarkSettings, graph: PoseGraph) -> None:
        self.robots = settings.robots(graph)
        self.max_rounds = settings.max_rounds
        self._deadline = time.perf_counter() + settings.time_limit

    @property
    def _time_limit(self) -> float:
        return max(self._deadline - time.perf_counter(), 1e-3)

    def run(
        self,
        solver: Solver[Any],
        problem: PGOProblem,
        start: Poses | None,
        callback: Callback | None = None,
    ) -> Run[Any]:
        """Run a solver in one process."""
        result: Run[Any] = run(
            solver, problem, start, callback=callback, time_limit=self._time_limit, progress=False
        )
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return result

    def solve(
        self, problem: PGOProblem, soc: SOC | None, newton: Newton, start: Poses | None
    ) -> tuple[Solution, StageRecords]:
        """Run SOC, if any, and Newton.

        Robots and their driver run them, or one process if SOC has no robots.
        """
        pipeline = replace(Pipeline().with_newton_alone(newton), soc=soc)
        robots = self.robots if soc is None else soc.robots
        solution = solve_whole(problem, pipeline, start, robots=robots, time_limit=self._time_limit)
        return solution, _records_of(solution)


def _one_run(
    solver: Solver[Any], name: str, problem: PGOProblem, budget: _Budget, start: Poses | None
) -> BenchmarkRun:
    result = budget.run(solver, problem, start)
    return _run_of(result, StageRecord(name, result.status, result.history))


def _run_of(
    result: Run[Any] | Solution, *stages: StageRecord, remark: str = "", is_answer: bool = True
) -> BenchmarkRun:
    """Run with these stages, of which `run_benchmark` sets the contender."""
    return BenchmarkRun(
        BenchmarkMethod.JOINT,
        stages,
        result.poses,
        result.objective,
        result.status,
        remark,
        is_answer,
    )


def _soc_and_newton(
    coupling: Coupling, problem: PGOProblem, budget: _Budget, start: Poses | None
) -> BenchmarkRun:
    """Run of a coupling as in `solve`: JOINT in one process, the others by robots and driver."""
    robots = None if coupling is Coupling.JOINT else budget.robots
    soc = replace(WARM_START, coupling=coupling, robots=robots)
    solution, stages = budget.solve(problem, soc, Newton(), start)
    return _run_of(solution, *stages)


def _paper(problem: PGOProblem, budget: _Budget, start: Poses | None) -> BenchmarkRun:
    """Run of the paper's SOC with one robot for every pose, and of Gauss-Newton."""
    max_rounds = budget.max_rounds
    first_stage, poses = _paper_soc(problem, budget, start)
    num_first_rounds = int(first_stage.history.k[-1])
    newton = replace(gauss_newton(), tolerance=_SECOND_STAGE_TOLERANCE)
    solution, second = budget.solve(problem, None, newton, poses)
    rounds = _with_translations(second)
    remark = ""
    if max_rounds is not None:
        is_within = num_first_rounds + rounds <= max_rounds
        last_step = int(np.flatnonzero(is_within).max(initial=0))
        if last_step < len(rounds) - 1:
            # It is run again, since the poses of that step were not kept.
            shorter = replace(newton, max_iterations=last_step)
            solution, second = budget.solve(problem, None, shorter, poses)
            rounds = _with_translations(second)
            remark = f"stopped within {max_rounds} rounds"
    second_stage = replace(second[0], rounds=rounds)
    return _run_of(solution, first_stage, second_stage, *second[1:], remark=remark)


def _paper_soc(
    problem: PGOProblem, budget: _Budget, start: Poses | None
) -> tuple[StageRecord, Poses]:
    """First stage of PAPER, and its poses: the last rotations with their best translations.

    They are not the best iterate, which `run` would return: no robot knows F, and computing it
    would take rounds.
    """
    max_iterations = _MOST_PAPER_ITERATIONS
    if budget.max_rounds is not None:
        max_iterations = max(1, int(_FIRST_STAGE_SHARE * budget.max_rounds))
    soc = PaperSOC(penalty=BalancedPenalty(_PAPER_SCALE), max_iterations=max_iterations)
    last_rotations: list[Array] = []

    def remember(state: PaperState, record: Record) -> None:
        if np.isfinite(record.measurement.objective):
            last_rotations[:] = [state.omega]

    result = budget.run(soc, problem, start, remember)
    poses = problem.with_best_translations(last_rotations[0])
    robots = partition(problem.graph, method=PartitionMethod.SINGLETONS)
    sweep = schedule(problem.graph, robots)
    traffic = sweep.traffic(np.arange(problem.num_poses), problem.d**2)
    bytes_per_round = float(traffic.num_bytes.sum())
    k = result.history.k
    stage = StageRecord(
        "SOC",
        result.status,
        result.history,
        robots.num_robots,
        rounds=k,
        num_bytes=k * bytes_per_round,
    )
    return stage, poses


def _with_translations(stages: StageRecords) -> Array:
    """Rounds of the first stage, and one more (not in bytes) that gives the translations."""
    assert stages[0].rounds is not None
    return stages[0].rounds + 1.0


def _gauss_seidel(problem: PGOProblem, budget: _Budget, start: Poses | None) -> BenchmarkRun:
    """Run of distributed Gauss-Seidel."""
    ledgers: list[Ledger] = []

    def remember(state: GaussSeidelState, record: Record) -> None:
        ledgers.append(state.ledger)

    method = GaussSeidel(robots=budget.robots, max_iterations=_MOST_SWEEPS)
    result = budget.run(method, problem, None, remember)
    stage = StageRecord(
        "DGS",
        result.status,
        result.history,
        budget.robots.num_robots,
        rounds=np.array([ledger.rounds for ledger in ledgers], dtype=float),
        num_bytes=np.array([ledger.num_bytes for ledger in ledgers], dtype=float),
    )
    is_answer = result.state.stage is not DGSStage.ROTATIONS
    remark = ""
    if not is_answer:
        ending = f"{result.status.name} in its first stage"
        remark = f"{ending}: no poses after {result.iterations} sweeps"
    return _run_of(result, stage, remark=remark, is_answer=is_answer)


def _gtsam(problem: PGOProblem, budget: _Budget, start: Poses | None) -> BenchmarkRun:
    """Run of GTSAM's Levenberg-Marquardt."""
    result = run_gtsam(problem, start=start)
    return _run_of(result, StageRecord("GTSAM", result.status, result.history))


def _records_of(solution: Solution) -> StageRecords:
    """Records of the stages of a solution; seconds and rounds of its start are in the first."""
    start, *others = solution.stages
    iterative = [stage for stage in others if len(stage.history)]
    num_robots = 1 if solution.robots is None else solution.robots.num_robots
    seconds_before = start.seconds
    rounds_before = 0.0
    bytes_before = 0.0
    stages: list[StageRecord] = []
    for stage in iterative:
        records = [
            replace(record, seconds=seconds_before + record.seconds)
            for record in stage.history.records
        ]
        seconds_before = 0.0
        rounds = _counted([record.measurement.rounds for record in records])
        num_bytes = _counted([record.measurement.num_bytes for record in records])
        if rounds is not None and num_bytes is not None:
            last_rounds = rounds[-1]
            last_bytes = num_bytes[-1]
            rounds = rounds - rounds_before
            num_bytes = num_bytes - bytes_before
            rounds_before = last_rounds
            bytes_before = last_bytes
        history = History(tuple(records))
        stages.append(StageRecord(stage.name, stage.status, history, num_robots, rounds, num_bytes))
    return tuple(stages)


def _counted(values: list[int | None]) -> Array | None:
    """Counts of every record; None if one is not known."""
    if any(value is None for value in values):
        return None
    return np.array(values, dtype=float)


_RUNS: dict[BenchmarkMethod, Callable[[PGOProblem, _Budget, Poses | None], BenchmarkRun]] = {
    BenchmarkMethod.JOINT: partial(_soc_and_newton, Coupling.JOINT),
    BenchmarkMethod.CONSENSUS: partial(_soc_and_newton, Coupling.CONSENSUS),
    BenchmarkMethod.PAPER: _paper,
    BenchmarkMethod.SUBSTRUCTURED: partial(_soc_and_newton, Coupling.SUBSTRUCTURED),
    BenchmarkMethod.STAIRCASE: partial(_one_run, Staircase(), "staircase"),
    BenchmarkMethod.GAUSS_SEIDEL: _gauss_seidel,
    BenchmarkMethod.NEWTON: partial(_one_run, Newton(), "Newton"),
    BenchmarkMethod.GTSAM: _gtsam,
}
