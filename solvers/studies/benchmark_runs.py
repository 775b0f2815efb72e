"""How the methods to compare are run on a graph; `solvers.studies.benchmark` has what comes of it."""

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
from solvers.baselines.gauss_seidel import DGSStage, GaussSeidel
from solvers.baselines.gtsam import run_gtsam
from solvers.baselines.levenberg_marquardt import LevenbergMarquardt
from solvers.baselines.sweep_order import Sweep, schedule
from solvers.loop import Solver, run
from solvers.network.ledger import Ledger
from solvers.pipeline import HANDOVER, Pipeline, solve
from solvers.result import OUT_OF_TIME, History, Record, Run, Status
from solvers.riemannian.newton import Newton, gauss_newton
from solvers.riemannian.staircase import Staircase
from solvers.soc.paper import PaperSOC, PaperState
from solvers.soc.penalty import BalancedPenalty
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC
from solvers.solution import Solution
from solvers.studies.benchmark import BenchmarkMethod, BenchmarkRun, BenchmarkSettings, StageRecord

# What a method can fail with on a graph that it was not made for; anything else is a mistake of ours.
FAILURES = (PGOError, np.linalg.LinAlgError, MemoryError)
Look = Callable[[Any, Record], None]
Legs = tuple[StageRecord, ...]
_MOST_SWEEPS = 20_000
_MOST_PAPER_ITERATIONS = 5_000
_SECOND_STAGE_TOLERANCE = 1e-6  # relative decrement; Gauss-Newton closes the rest slowly
# First rho of PAPER over m_i: the paper gives none. Of 0.3, 1 and 3, tried on draws 100 to 109 of its scenes, the first
# lets the early iterates stray far, the other two do alike.
_PAPER_SCALE = 1.0
_FIRST_STAGE_SHARE = 0.5  # of the rounds that the paper's method may take; an early Gauss-Newton step takes up to seven


def run_benchmark(
    method: BenchmarkMethod, problem: PGOProblem, settings: BenchmarkSettings | None = None, start: Poses | None = None
) -> BenchmarkRun:
    """Run a contender on a graph from its start to its end.

    The couplings of SOC hand over to Newton as `solve` does, PAPER to Gauss-Newton. PAPER's second stage and all of
    CONSENSUS and SUBSTRUCTURED are run by the robots and a driver, whose ledger counts. An iteration of PAPER is one
    round between neighbours, and one more, whose bytes are not counted, gives the translations. Its first stage hands
    on its last iterate, whatever F is there. All but GAUSS_SEIDEL take the start given, or find their own.

    A PGOError when the method cannot be run on this graph; KeyboardInterrupt after Ctrl-C: half a trial is none.
    """
    settings = settings if settings is not None else BenchmarkSettings()
    trial = _RUNS[method](problem, _Budget(settings, problem.graph), start)
    status = next((leg.status for leg in trial.legs if leg.status in OUT_OF_TIME), trial.status)
    said = [trial.remark] if trial.remark else []
    if method is not BenchmarkMethod.PAPER or settings.max_rounds is None:
        said += [f"{leg.name}: {leg.status.name}" for leg in trial.legs[:-1] if not leg.status.is_success]
    if not said and not status.is_success:
        said = [status.name]
    return replace(trial, contender=method, status=status, remark="; ".join(said))


def reason_of(error: BaseException) -> str:
    """Why a method failed."""
    return str(error) or type(error).__name__


def solve_whole(problem: PGOProblem | PoseGraph, *args: Any, **settings: Any) -> Solution:  # noqa: ANN401 - those of `solve`
    """Return what `solve` finds, without a bar; KeyboardInterrupt after Ctrl-C: half a solve is none."""
    solution = solve(problem, *args, **settings, progress=False)
    if any(stage.status is Status.INTERRUPTED for stage in solution.stages):
        raise KeyboardInterrupt
    return solution


class _Budget:
    """Settings and robots of a trial, and the time that is left of it."""

    def __init__(self, settings: BenchmarkSettings, graph: PoseGraph) -> None:
        self.robots = settings.robots(graph)
        self.max_rounds = settings.max_rounds
        self._deadline = time.perf_counter() + settings.time_limit

    @property
    def _time_limit(self) -> float:
        return max(self._deadline - time.perf_counter(), 1e-3)

    def run(self, solver: Solver[Any], problem: PGOProblem, start: Poses | None, look: Look | None = None) -> Run[Any]:
        """Run a solver in one place; `look` is the callback."""
        finished: Run[Any] = run(solver, problem, start, callback=look, time_limit=self._time_limit, progress=False)
        if finished.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return finished

    def solve(self, problem: PGOProblem, soc: SOC | None, newton: Newton, start: Poses | None) -> tuple[Solution, Legs]:
        """SOC, if any, and Newton, by the robots and their driver, or in one place if SOC has none."""
        pipeline = Pipeline(soc=soc, newton=newton, second_try=False, staircase=None)
        robots = self.robots if soc is None else soc.robots
        solution = solve_whole(problem, pipeline, start, robots=robots, time_limit=self._time_limit)
        return solution, _legs_of(solution)


def _one_run(solver: Solver[Any], name: str, problem: PGOProblem, budget: _Budget, start: Poses | None) -> BenchmarkRun:
    finished = budget.run(solver, problem, start)
    return _run_of(finished, StageRecord(name, finished.status, finished.history))


def _run_of(found: Run[Any] | Solution, *legs: StageRecord, remark: str = "", is_answer: bool = True) -> BenchmarkRun:
    """A run with these legs; `run_benchmark` says whose it is."""
    return BenchmarkRun(BenchmarkMethod.JOINT, legs, found.poses, found.objective, found.status, remark, is_answer)


def _soc_and_newton(coupling: Coupling, problem: PGOProblem, budget: _Budget, start: Poses | None) -> BenchmarkRun:
    """A run of a coupling as `solve` runs it: JOINT in one place, the others by robots and their driver."""
    soc = replace(HANDOVER, coupling=coupling, robots=None if coupling is Coupling.JOINT else budget.robots)
    solution, legs = budget.solve(problem, soc, Newton(), start)
    return _run_of(solution, *legs)


def _paper(problem: PGOProblem, budget: _Budget, start: Poses | None) -> BenchmarkRun:
    total = budget.max_rounds
    most = _MOST_PAPER_ITERATIONS if total is None else max(1, int(_FIRST_STAGE_SHARE * total))
    soc = PaperSOC(penalty=BalancedPenalty(_PAPER_SCALE), max_iterations=most)
    last_rotations: list[Array] = []

    def remember(state: PaperState, record: Record) -> None:
        if np.isfinite(record.measurement.objective):
            last_rotations[:] = [state.omega]

    first = budget.run(soc, problem, start, remember)
    # The last iterate, not the best one that `run` would give back: no robot knows F, and to know it would cost rounds.
    handed_over = problem.with_best_translations(last_rotations[0])
    alone = partition(problem.graph, method=PartitionMethod.SINGLETONS)
    exchange = schedule(problem.graph, alone, Sweep.JACOBI).traffic(np.arange(problem.num_poses), problem.d**2)
    k = first.history.k
    leg = StageRecord("SOC", first.status, first.history, alone.num_robots, k, k * float(exchange.num_bytes.sum()))
    newton = replace(gauss_newton(), tolerance=_SECOND_STAGE_TOLERANCE)
    solution, last = budget.solve(problem, None, newton, handed_over)
    rounds, remark = _with_translations(last), ""
    if total is not None:
        within = int(np.flatnonzero(k[-1] + rounds <= total).max(initial=0))
        if within < len(rounds) - 1:
            solution, last = budget.solve(problem, None, replace(newton, max_iterations=within), handed_over)
            rounds, remark = _with_translations(last), f"stopped within {total} rounds"
    return _run_of(solution, leg, replace(last[0], rounds=rounds), *last[1:], remark=remark)


def _with_translations(legs: Legs) -> Array:
    """Rounds of the first leg and the one, without its bytes, in which robots that know rotations get translations."""
    assert legs[0].rounds is not None
    return legs[0].rounds + 1.0


def _gauss_seidel(problem: PGOProblem, budget: _Budget, start: Poses | None) -> BenchmarkRun:
    ledgers: list[Ledger] = []
    method = GaussSeidel(robots=budget.robots, max_iterations=_MOST_SWEEPS)
    ended = budget.run(method, problem, None, lambda state, record: ledgers.append(state.ledger))
    rounds, num_bytes = np.array([(ledger.rounds, ledger.num_bytes) for ledger in ledgers], dtype=float).T
    leg = StageRecord("DGS", ended.status, ended.history, budget.robots.num_robots, rounds, num_bytes)
    is_answer = ended.state.stage is not DGSStage.ROTATIONS
    remark = "" if is_answer else f"{ended.status.name} in its first stage: no poses after {ended.iterations} sweeps"
    return _run_of(ended, leg, remark=remark, is_answer=is_answer)


def _gtsam(problem: PGOProblem, budget: _Budget, start: Poses | None) -> BenchmarkRun:
    finished = run_gtsam(problem, start=start)
    return _run_of(finished, StageRecord("GTSAM", finished.status, finished.history))


def _legs_of(solution: Solution) -> Legs:
    """Legs of a solution; the seconds and rounds of its start are part of the first."""
    legs: list[StageRecord] = []
    start = solution.stages[0].seconds
    num_robots = 1 if solution.robots is None else solution.robots.num_robots
    rounds_before = bytes_before = 0.0
    for stage in solution.stages[1:]:
        records = tuple(replace(record, seconds=start + record.seconds) for record in stage.history.records)
        history, start = History(records), 0.0
        rounds = _counted([record.measurement.rounds for record in records])
        num_bytes = _counted([record.measurement.num_bytes for record in records])
        if rounds is not None and num_bytes is not None:
            last = rounds[-1], num_bytes[-1]
            rounds, num_bytes = rounds - rounds_before, num_bytes - bytes_before
            rounds_before, bytes_before = last
        legs.append(StageRecord(stage.name, stage.status, history, num_robots, rounds, num_bytes))
    return tuple(legs)


def _counted(values: list[int | None]) -> Array | None:
    """Counts of every record; None where one is not known."""
    known = [value for value in values if value is not None]
    return np.array(known, dtype=float) if len(known) == len(values) else None


_RUNS: dict[BenchmarkMethod, Callable[[PGOProblem, _Budget, Poses | None], BenchmarkRun]] = {
    BenchmarkMethod.JOINT: partial(_soc_and_newton, Coupling.JOINT),
    BenchmarkMethod.CONSENSUS: partial(_soc_and_newton, Coupling.CONSENSUS),
    BenchmarkMethod.PAPER: _paper,
    BenchmarkMethod.SUBSTRUCTURED: partial(_soc_and_newton, Coupling.SUBSTRUCTURED),
    BenchmarkMethod.STAIRCASE: partial(_one_run, Staircase(), "staircase"),
    BenchmarkMethod.GAUSS_SEIDEL: _gauss_seidel,
    BenchmarkMethod.NEWTON: partial(_one_run, Newton(), "Newton"),
    BenchmarkMethod.LEVENBERG_MARQUARDT: partial(_one_run, LevenbergMarquardt(), "Levenberg-Marquardt"),
    BenchmarkMethod.GTSAM: _gtsam,
}
