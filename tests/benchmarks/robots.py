"""Prints the tables of many robots (README.md beside this file): rounds, bytes, seconds, faults, a
world of 100 robots.

    PGO_DATA=folder python tests/benchmarks/robots.py
    [substructured|consensus|held|seconds|faults|driver|world|ray|interleaved ..]

Every line runs in a process of its own, one thread, robots in this process; those of `ray` in
actors on two CPUs, too, and those of `interleaved` in a process each.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"

import numpy as np
from held_poses import rounds_held
from rich.box import MARKDOWN
from rich.console import Console
from rich.table import Table
from unit import seconds_of_unit

import pgo_models as pgo
import solvers
from pgo_models.figures import rounded_up
from pgo_models.graphs.separators import vertex_cover
from solvers import Faults, InProcess, RayEngine, run
from solvers.carry.counted_pool import Count
from solvers.carry.process import Engine
from solvers.carry.ray_cluster import connect
from solvers.result import History, Record, Run
from solvers.robots.consensus import AsynchronousSOC, AsynchronousState, RobotsOfDriver
from solvers.robots.setup import open_driver
from solvers.soc.consensus import ask_all
from solvers.soc.consensus_robot import ConsensusRobot

REFERENCE = json.loads((Path(__file__).parents[2] / "data" / "reference.json").read_text())
OPTIMUM = REFERENCE["certified_optimum"]
AMM = REFERENCE["peers"]["amm_pgo"]
NAMES = list(AMM["rounds"])
LEVELS = (1e-3, 1e-4, 1e-6)
MAX_ROUNDS = 400
FAULTS = {
    "none": Faults(),
    "20 % lost": Faults(loss=0.2, seed=1),
    "up to 5 late": Faults(max_delay=5, seed=1),
    "one silent for 50": Faults(silent_robot=2, silent_from=5, silent_rounds=50),
}
METIS = pgo.PartitionMethod.METIS
CONTIGUOUS = pgo.PartitionMethod.CONTIGUOUS


def substructured_job(name: str, robots: str, method: str) -> dict[str, object]:
    """Whole solve by driver and robots."""
    graph = replace(pgo.load(name), information=None)  # the cost is F
    shared = pgo.partition(graph, int(robots), pgo.PartitionMethod[method])
    solution = solvers.solve(graph, robots=shared)
    return {
        "cover": len(vertex_cover(shared, graph)),
        "soc": sum(stage.iterations for stage in solution.stages if stage.name == "SOC"),
        "rounds": solution.ledger.rounds,
        "all_reduces": solution.ledger.all_reduces,
        "sent": solution.ledger.bytes_sent.max() / 1e3,
        "received": solution.ledger.bytes_received.max() / 1e3,
        "gap": solution.certificate.proven_gap,
        "verdict": solution.certificate.verdict.name,
        "seconds": solution.seconds,
        "memory": memory(),
    }


def consensus_job(name: str, robots: str, method: str) -> dict[str, object]:
    """Rounds of CONSENSUS from the chordal start to three relative gaps; default settings."""
    problem = pgo.PGOProblem(pgo.load(name), weighting=pgo.Weighting.ISOTROPIC)
    shared = pgo.partition(problem.graph, int(robots), pgo.PartitionMethod[method])
    done = to_gap(
        problem,
        solvers.SOC(robots=shared, tolerance=1e-12, max_iterations=MAX_ROUNDS),
        OPTIMUM[name],
    )
    return {
        "rounds": rounds_to(done.history, OPTIMUM[name]),
        "seconds": float(done.history.seconds[-1]),
        "memory": memory(),
    }


def held_job(name: str, robots: str) -> dict[str, object]:
    """Rounds of CONSENSUS until the poses that the robots hold cost so much; METIS partition."""
    return rounds_held(
        name, int(robots), [OPTIMUM[name] + level * max(1.0, OPTIMUM[name]) for level in LEVELS]
    )


def faults_job(name: str, fault: str) -> dict[str, object]:
    """Rounds of the asynchronous CONSENSUS, 5 robots, METIS partition, to 1e-6; the whole graph
    measures omega.
    """
    graph = replace(pgo.load(name), information=None)  # the cost is F
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.ISOTROPIC)
    shared = pgo.partition(graph, 5, METIS)
    driver = open_driver(problem, shared, InProcess())
    driver.go_to_chordal_start()
    soc = solvers.SOC(robots=shared, tolerance=1e-12, max_iterations=MAX_ROUNDS)
    gaps = []

    def is_done(state: AsynchronousState, record: Record) -> bool:
        R = np.empty((graph.num_poses, graph.d, graph.d))
        for own in ask_all(RobotsOfDriver(driver), ConsensusRobot.own_poses, None, Count.OFF):
            R[own.poses] = own.R
        gaps.append(gap_of(problem.objective(problem.with_best_translations(R)), OPTIMUM[name]))
        return (
            gaps[-1] <= LEVELS[-1]
            and not FAULTS[fault].is_silent(2, state.k)
            and state.k > FAULTS[fault].silent_from
        )

    outcome = run(AsynchronousSOC(soc, FAULTS[fault]), driver, callback=is_done)
    return {"rounds": outcome.iterations if gaps[-1] <= LEVELS[-1] else None}


def ray_job(name: str, robots: str, coupling: str) -> dict[str, object]:
    """Iterations of SOC, no tolerance, in this process and in two actors: least of five solves
    each.
    """
    graph = replace(pgo.load(name), information=None)  # the cost is F
    shared = pgo.partition(graph, int(robots), METIS)
    soc = solvers.SOC(
        robots=shared, coupling=solvers.Coupling[coupling], tolerance=1e-14, max_iterations=40
    )
    pipeline = solvers.Pipeline(soc=soc, other_starts=False, staircase=None)

    def least(engine: Engine) -> dict[str, float]:
        found = []
        for _ in range(5):
            began = time.perf_counter()
            cpu = time.process_time()
            solution = solvers.solve(graph, pipeline, robots=solvers.Robots(shared, engine=engine))
            whole = time.perf_counter() - began
            driver = time.process_time() - cpu
            (stage,) = (stage for stage in solution.stages if stage.name == "SOC")
            steps = np.diff(stage.history.seconds)
            found.append(
                (
                    stage.seconds / stage.iterations,
                    np.median(steps),
                    driver / stage.iterations,
                    whole,
                )
            )
        return dict(
            zip(("mean", "median", "cpu", "whole"), np.min(found, axis=0).tolist(), strict=True)
        )

    here = least(InProcess())
    connect(num_cpus=2)
    return {"here": here, "there": least(RayEngine())}


def world_job() -> dict[str, object]:
    """A world of 100 robots and 50,000 poses in space, read from the folder that `pgo generate`
    wrote.
    """
    with tempfile.TemporaryDirectory() as folder:
        world = Path(folder) / "world"
        run_cli(
            ["generate", "grid-world", "--robots", "100", "--poses", "500", "--out", str(world)]
        )
        began = time.perf_counter()
        graph = replace(pgo.load(str(world)), information=None)  # the cost is F
        solution = solvers.solve(graph, robots=pgo.partition(graph, 100, METIS))
        seconds = time.perf_counter() - began
    return {
        "poses": graph.num_poses,
        "edges": graph.num_edges,
        "rounds": solution.ledger.rounds,
        "sent": solution.ledger.bytes_sent.max() / 1e6,
        "received": solution.ledger.bytes_received.max() / 1e6,
        "gap": solution.certificate.proven_gap,
        "verdict": solution.certificate.verdict.name,
        "seconds": seconds,
        "memory": memory(),
    }


def interleaved_job(poses: str) -> dict[str, object]:
    """Sixteen robots in the plane, whose areas interleave, with their own files, in Ray actors."""
    with tempfile.TemporaryDirectory() as folder:
        world = Path(folder) / "world"
        shape = ["--robots", "16", "--poses", poses, "-d", "2"]
        run_cli(["generate", "grid-world", *shape, "--out", str(world)])
        began = time.perf_counter()
        engine = RayEngine(num_cpus=16, actors=16)
        with watching("ray::") as actors:
            solution = solvers.solve_folder(world, robots=solvers.Robots(engine=engine))
        seconds = time.perf_counter() - began
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return {
        "poses": int(solution.sizes[0].sum()),
        "edges": int(solution.sizes[1].sum()),
        "rounds": solution.ledger.rounds,
        "megabytes": solution.ledger.num_bytes / 1e6,
        "driver": usage.ru_utime + usage.ru_stime,
        "busiest": max(cpu for cpu, _ in actors.values()),
        "robots": sum(cpu for cpu, _ in actors.values()),
        "driver_memory": memory(),
        "robot_memory": max(megabytes for _, megabytes in actors.values()),
        "gap": solution.certificate.proven_gap,
        "verdict": solution.certificate.verdict.name,
        "seconds": seconds,
    }


@contextmanager
def watching(name: str) -> Iterator[dict[str, tuple[float, float]]]:
    """CPU seconds and largest memory, MB, of all processes whose command begins so, by process.

    They are read twice a second for as long as the block runs, as the processes end before it.
    """
    figures: dict[str, tuple[float, float]] = {}
    has_ended = threading.Event()

    def watch() -> None:
        while not has_ended.wait(0.5):
            figures.update(processes_of(name))

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield figures
    finally:
        has_ended.set()
        thread.join()


def processes_of(name: str) -> dict[str, tuple[float, float]]:
    """CPU seconds and largest memory, MB, of the processes whose command begins so (Linux)."""
    figures = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            command = (folder / "cmdline").read_text()
            status = (folder / "status").read_text()
            numbers = (folder / "stat").read_text().rsplit(")", 1)[1].split()
        except OSError:  # it has ended
            continue
        # Idle workers that Ray has started in advance hold no robot.
        if command.startswith(name) and "IDLE" not in command:
            ticks = int(numbers[11]) + int(numbers[12])
            (peak,) = (line.split()[1] for line in status.splitlines() if "VmHWM" in line)
            figures[folder.name] = (ticks / os.sysconf("SC_CLK_TCK"), int(peak) / 1024)
    return figures


class TimedRobots:
    """Robots in this process, whose CPU seconds are counted one by one."""

    def __init__(self) -> None:
        self.seconds = np.zeros(0)

    def open(self, make: Callable[[Any], Any], shares: Sequence[Any]) -> "TimedRobots":
        """Robots of these shares."""
        self.seconds = np.zeros(len(shares))
        robots = range(len(shares))
        self._pool = InProcess().open(
            lambda robot: (robot, self._timed(robot, make, shares[robot])), robots
        )
        return self

    def ask(self, order: Callable[[Any, Any], Any], requests: Sequence[Any]) -> list[Any]:
        """Answers of all to an order."""
        return self._pool.ask(
            lambda held, request: self._timed(held[0], order, held[1], request), requests
        )

    def close(self) -> None:
        """Let them go."""
        self._pool.close()

    def _timed(self, robot: int, act: Callable[..., Any], *arguments: object) -> Any:
        began = time.process_time()
        answer = act(*arguments)
        self.seconds[robot] += time.process_time() - began
        return answer


def driver_job(robots: str, poses: str) -> dict[str, object]:
    """CPU of the driver and of the busiest robot, in a world in the plane; METIS partition."""
    with tempfile.TemporaryDirectory() as folder:
        world = Path(folder) / "world.g2o"
        shape = ["--robots", robots, "--poses", poses, "-d", "2"]
        run_cli(["generate", "grid-world", *shape, "--out", str(world)])
        graph = replace(pgo.load(str(world)), information=None)  # the cost is F
    shared = pgo.partition(graph, int(robots), METIS)
    timed = TimedRobots()
    began = time.process_time()
    solution = solvers.solve(graph, robots=solvers.Robots(shared, engine=timed))
    total = time.process_time() - began
    return {
        "poses": graph.num_poses,
        "cover": len(vertex_cover(shared, graph)),
        "rounds": solution.ledger.rounds,
        "driver": total - timed.seconds.sum(),
        "busiest": timed.seconds.max(),
        "sent": round(1e-6 * solution.ledger.num_bytes, 1),
        "gap": solution.certificate.proven_gap,
        "verdict": solution.certificate.verdict.name,
        "memory": memory(),
    }


def run_cli(arguments: list[str]) -> None:
    """`pgo` with these arguments."""
    code = "from solvers.cli.app import main; main()"
    subprocess.run(
        [sys.executable, "-c", code, *arguments], check=True, capture_output=True, env=os.environ
    )


def to_gap(problem: pgo.PGOProblem, soc: solvers.SOC, optimum: float) -> Run:
    """Run until the smallest of the levels is reached."""
    return solvers.run(
        soc,
        problem,
        callback=lambda state, record: gap_of(record.measurement.objective, optimum) <= LEVELS[-1],
    )


def gap_of(objective: float, optimum: float) -> float:
    """Relative distance to the published optimum."""
    return (objective - optimum) / max(1.0, optimum)


def rounds_to(history: History, optimum: float) -> list[int | None]:
    """First iterate within each of the levels."""
    gaps = [gap_of(objective, optimum) for objective in history.objective]
    return [next((k for k, gap in enumerate(gaps) if gap <= level), None) for level in LEVELS]


def memory() -> float:
    """Largest memory of this process, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def substructured_table() -> Table:
    """SUBSTRUCTURED: start, SOC, Newton, certificate; METIS partition (then contiguous parts)."""
    heads = (
        "graph",
        "robots",
        "cover",
        "SOC",
        "rounds",
        "all-reduces",
        "sent, kB",
        "received, kB",
        "gap",
        "s",
        "MB",
    )
    table = Table(*heads, box=MARKDOWN)
    cases = [(name, k, METIS) for name in NAMES for k in (5, 25)]
    cases += [
        (name, k, CONTIGUOUS) for name in ("sphere2500", "torus3D", "kitti_00") for k in (5, 25)
    ]
    for name, robots, method in cases:
        row = child("substructured", name, str(robots), method.name)
        table.add_row(
            name + ("" if method is METIS else ", contiguous"),
            str(robots),
            *(str(row[key]) for key in ("cover", "soc", "rounds", "all_reduces")),
            *(f"{row[key]:.0f}" for key in ("sent", "received")),
            f"{rounded_up(row['gap'], 2)}"
            f" {'' if row['verdict'] == 'CERTIFIED' else row['verdict']}",
            f"{row['seconds']:.2f}",
            f"{row['memory']:.0f}",
        )
    return table


def consensus_table() -> Table:
    """CONSENSUS, default settings: iterations to gaps of 1e-3 / 1e-4 / 1e-6, with the best
    translations for omega.
    """
    table = Table("graph", "5, METIS", "5, contiguous", "25, METIS", "25, contiguous", box=MARKDOWN)
    for name in NAMES:
        cells = [
            as_text(child("consensus", name, str(robots), method.name)["rounds"])
            for robots, method in ((5, METIS), (5, CONTIGUOUS), (25, METIS), (25, CONTIGUOUS))
        ]
        table.add_row(name, *cells)
    return table


def held_table() -> Table:
    """CONSENSUS, default settings, F at the poses held: all rounds to 1e-3 / 1e-4 / 1e-6, those of
    the start apart.
    """
    table = Table("graph", "5, METIS", "of these, start", "25, METIS", "AMM-PGO, 5", box=MARKDOWN)
    for name in NAMES:
        five, many = (child("held", name, robots) for robots in ("5", "25"))
        rounds = five["rounds"], many["rounds"], [AMM["rounds"][name][k] for k in (0, 1, 3)]
        of_five, of_many, theirs = map(as_text, rounds)
        table.add_row(name, of_five, str(five["start"]), of_many, theirs)
    return table


def seconds_table() -> Table:
    """Seconds to 1e-6 of 5 robots by METIS, summed over robots: chordal start not included."""
    table = Table(
        "graph",
        "CONSENSUS, s",
        "u",
        "whole SUBSTRUCTURED solve, s",
        "u",
        "AMM-PGO, u",
        "MB",
        box=MARKDOWN,
    )
    for name in ("sphere2500", "torus3D", "cubicle"):
        unit = seconds_of_unit()
        one = child("consensus", name, "5", "METIS")
        other = child("substructured", name, "5", "METIS")
        table.add_row(
            name,
            f"{one['seconds']:.2f}",
            f"{one['seconds'] / unit:.1f}",
            f"{other['seconds']:.2f}",
            f"{other['seconds'] / unit:.1f}",
            f"{AMM['units'][name]:.1f}",
            f"{max(one['memory'], other['memory']):.0f}",
        )
    return table


def faults_table() -> Table:
    """CONSENSUS without waiting (no all-reduce), 5 robots, METIS: rounds to 1e-6 under faults."""
    table = Table("graph", *FAULTS, box=MARKDOWN)
    for name in NAMES:
        if name not in ("CSAIL", "parking-garage", "kitti_00", "city10000"):
            table.add_row(name, *(str(child("faults", name, fault)["rounds"]) for fault in FAULTS))
    return table


def driver_table() -> Table:
    """Driver and busiest robot of SUBSTRUCTURED solves in the plane: CPU seconds, MB sent on each
    level of the tree.
    """
    heads = (
        "poses",
        "robots",
        "cover",
        "rounds",
        "driver, s",
        "busiest robot, s",
        "MB sent",
        "gap",
        "MB",
    )
    table = Table(*heads, box=MARKDOWN)
    for robots, poses in ((100, 228), (144, 903)):
        row = child("driver", str(robots), str(poses))
        table.add_row(
            str(row["poses"]),
            str(robots),
            *(str(row[key]) for key in ("cover", "rounds")),
            *(f"{row[key]:.2f}" for key in ("driver", "busiest")),
            str(row["sent"]),
            f"{rounded_up(row['gap'], 2)} {row['verdict']}",
            f"{row['memory']:.0f}",
        )
    return table


def interleaved_table() -> Table:
    """Sixteen robots on Ray, whose areas interleave: CPU seconds and memory of every process."""
    heads = (
        "poses",
        "edges",
        "rounds",
        "MB sent",
        "driver, CPU s",
        "busiest robot",
        "all robots",
        "driver, MB",
        "largest robot",
        "gap",
        "s",
    )
    table = Table(*heads, box=MARKDOWN)
    for poses in ("1250", "18750"):
        row = child("interleaved", poses)
        table.add_row(
            *(str(row[key]) for key in ("poses", "edges", "rounds")),
            f"{row['megabytes']:.0f}",
            *(f"{row[key]:.1f}" for key in ("driver", "busiest", "robots")),
            *(f"{row[key]:.0f}" for key in ("driver_memory", "robot_memory")),
            f"{rounded_up(row['gap'], 2)} {row['verdict']}",
            f"{row['seconds']:.0f}",
        )
    return table


def world_table() -> Table:
    """100 robots, 50,000 poses: read, solved and certified in this process."""
    row = child("world")
    table = Table(
        "poses",
        "edges",
        "rounds",
        "sent, MB a robot",
        "received",
        "gap",
        "seconds",
        "MB",
        box=MARKDOWN,
    )
    table.add_row(
        *(str(row[key]) for key in ("poses", "edges", "rounds")),
        *(f"{row[key]:.1f}" for key in ("sent", "received")),
        f"{rounded_up(row['gap'], 2)} {row['verdict']}",
        *(f"{row[key]:.0f}" for key in ("seconds", "memory")),
    )
    return table


def ray_table() -> Table:
    """Robots in two Ray actors: ms an iteration of SOC, set-up and snapshots included; whole
    solves.
    """
    heads = (
        "graph",
        "robots",
        "coupling",
        "process, ms",
        "Ray, ms",
        "(median)",
        "driver's CPU, ms",
        "solve, s",
    )
    table = Table(*heads, box=MARKDOWN)
    for name, robots in (("smallGrid3D", 5), ("smallGrid3D", 25), ("sphere2500", 5)):
        for coupling in ("SUBSTRUCTURED", "CONSENSUS"):
            row = child("ray", name, str(robots), coupling)
            here = row["here"]
            there = row["there"]
            figures = here["mean"], there["mean"], there["median"], there["cpu"]
            table.add_row(
                name,
                str(robots),
                coupling,
                *(f"{1e3 * x:.1f}" for x in figures),
                f"{there['whole']:.2f}",
            )
    return table


def as_text(rounds: list[int | None]) -> str:
    """Rounds to the levels."""
    return " / ".join("-" if count is None else str(count) for count in rounds)


def child(*arguments: str) -> dict:
    """Figures of a job in a process of its own."""
    finished = subprocess.run(
        [sys.executable, __file__, "--job", *arguments],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ,
    )
    return json.loads(finished.stdout)


JOBS: dict[str, Callable[..., dict[str, object]]] = {
    "substructured": substructured_job,
    "consensus": consensus_job,
    "held": held_job,
    "faults": faults_job,
    "driver": driver_job,
    "world": world_job,
    "ray": ray_job,
    "interleaved": interleaved_job,
}
TABLES = {
    "substructured": substructured_table,
    "consensus": consensus_table,
    "held": held_table,
    "seconds": seconds_table,
    "faults": faults_table,
    "driver": driver_table,
    "world": world_table,
    "ray": ray_table,
    "interleaved": interleaved_table,
}

if __name__ == "__main__":
    if sys.argv[1:2] == ["--job"]:
        print(json.dumps(JOBS[sys.argv[2]](*sys.argv[3:])))
    else:
        for chosen in sys.argv[1:] or TABLES:
            print(TABLES[chosen].__doc__)
            Console(width=150).print(TABLES[chosen]())
