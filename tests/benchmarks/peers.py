"""Prints the table of distributed methods side by side (README.md beside this file): rounds and
bytes of the common start, to three levels of F, and to a proof.

    PGO_DATA=folder python tests/benchmarks/peers.py [graph ..] [--robots 5,25,50] [--methods MESA]

Every row runs in a process of its own, one thread, all robots in that process.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"

from mesa import Mesa
from rich.box import MARKDOWN
from rich.console import Console
from rich.table import Table

import pgo_models as pgo
import solvers
from pgo_models import chordal_start
from pgo_models.graphs.partitioning import Partition
from solvers import InProcess, run
from solvers.carry.ledger import Ledger
from solvers.result import Record
from solvers.robots.consensus import ConsensusSOC
from solvers.robots.driver import Driver
from solvers.robots.place_without_driver import collect_copies
from solvers.robots.setup import open_driver

REFERENCE = json.loads((Path(__file__).parents[2] / "data" / "reference.json").read_text())
GRAPHS = ("smallGrid3D", "sphere2500", "intel", "kitti_07", "kitti_00")
LEVELS = (1e-3, 1e-4, 1e-6)
MAX_ROUNDS = 1000
MAX_SECONDS = 60.0  # CPU time of a run
# The best of these counts.
PENALTIES = (0.4, 0.3, 0.2, 0.1, 0.05, 0.03, 0.02, 0.01, 0.005)  # of MESA
MULTIPLIER_STEPS = (1.9, 1.0)  # of MESA
OVER_RELAXATIONS = (1.0, 1.5, 1.8)  # of DGS
ALPHAS = (1.0, 1.9)  # of CONSENSUS at its best
TRANSLATION_PENALTIES = (None, 0.5, 0.2)  # of CONSENSUS at its best
DGS_TOLERANCE = 1e-3  # change of a sweep after which DGS linearises again


@dataclass
class Watch:
    """What was sent until F came within each of the levels, and whether to go on."""

    optimum: float
    max_rounds: int = MAX_ROUNDS
    reached: dict[float, tuple[int, int]] = field(default_factory=dict)
    began: float = field(default_factory=time.process_time)

    def is_over(self, objective: float, rounds: int, num_bytes: int) -> bool:
        """Note a state; whether all levels are reached, or a limit."""
        gap = (objective - self.optimum) / max(1.0, self.optimum)
        for level in LEVELS:
            if gap <= level:
                self.reached.setdefault(level, (rounds, num_bytes))
        is_late = time.process_time() - self.began > MAX_SECONDS
        return len(self.reached) == len(LEVELS) or rounds >= self.max_rounds or is_late

    def row(self, **others: object) -> dict[str, Any]:
        """Figures of the run."""
        to_levels = [self.reached.get(level) for level in LEVELS]
        seconds = time.process_time() - self.began
        return {"levels": to_levels, "proof": None, "seconds": seconds, **others}


@dataclass(frozen=True)
class Case:
    """A graph, its robots and its certified optimum."""

    problem: pgo.PGOProblem
    robots: Partition
    optimum: float

    @classmethod
    def of(cls, name: str, robots: int) -> "Case":
        """The graph with this name, and contiguous parts."""
        graph = replace(pgo.load(name), information=None)  # the cost is F
        problem = pgo.PGOProblem(graph)
        parts = pgo.partition(graph, robots, pgo.PartitionMethod.CONTIGUOUS)
        optimum = REFERENCE["certified_optimum"].get(name)
        if optimum is None:
            optimum = solvers.solve(problem).objective
        return cls(problem, parts, optimum)

    def opened(self) -> Driver:
        """Driver and robots at the chordal start, whose two rounds are on the ledger."""
        driver = open_driver(self.problem, self.robots, InProcess())
        driver.go_to_chordal_start()
        return driver

    def chordal_start(self) -> tuple[pgo.Poses, Ledger]:
        """The same start for a method without that driver, and what it took."""
        return chordal_start(self.problem), self.opened().network.ledger


def consensus(case: Case) -> dict[str, Any]:
    """CONSENSUS, at the poses that the robots hold."""
    return _consensus(case, solvers.SOC(robots=case.robots), MAX_ROUNDS)


def tuned_consensus(case: Case) -> dict[str, Any]:
    """CONSENSUS with the best of its over-relaxations and translation penalties."""
    rows: list[dict[str, Any]] = []
    for alpha, penalty in product(ALPHAS, TRANSLATION_PENALTIES):
        soc = solvers.SOC(robots=case.robots, alpha=alpha, translation_penalty=penalty)
        row = _consensus(case, soc, _rounds_of_best(rows))
        text = "default" if penalty is None else f"{penalty:g}"
        rows.append({**row, "remark": f"alpha {alpha:g}, translation penalty {text}"})
    return min(rows, key=_preference)


def _consensus(case: Case, settings: solvers.SOC, max_rounds: int) -> dict[str, Any]:
    """Figures of CONSENSUS with these settings."""
    watch = Watch(case.optimum, max_rounds)
    driver = case.opened()
    start = driver.network.ledger
    soc = replace(settings, tolerance=1e-12, max_iterations=MAX_ROUNDS)

    def is_over(state: object, record: Record) -> bool:
        ledger = driver.network.ledger
        objective = case.problem.objective(collect_copies(driver))
        return watch.is_over(objective, ledger.rounds, ledger.num_bytes)

    run(ConsensusSOC(soc), driver, callback=is_over)
    return watch.row(start=(start.rounds, start.num_bytes))


def substructured(case: Case) -> dict[str, Any]:
    """A whole solve by driver and robots, to its certificate."""
    watch = Watch(case.optimum)
    solution = solvers.solve(case.problem, robots=case.robots)
    for stage in solution.stages:
        for record in stage.history.records:
            figures = record.measurement
            if figures.rounds is not None and figures.num_bytes is not None:
                watch.is_over(figures.objective, figures.rounds, figures.num_bytes)
    proof = None
    if solution.certificate.is_certified:
        proof = solution.ledger.rounds, solution.ledger.num_bytes
    return watch.row(proof=proof)


def gauss_seidel(case: Case) -> dict[str, Any]:
    """DGS from its own start, its flagged first stage, with the best of its settings."""
    rows: list[dict[str, Any]] = []
    for alpha in OVER_RELAXATIONS:
        watch = Watch(case.optimum, _rounds_of_best(rows))
        method = solvers.GaussSeidel(
            case.robots, alpha=alpha, gauss_newton_steps=MAX_ROUNDS, tolerance=DGS_TOLERANCE
        )

        def is_over(state: Any, record: Record, watch: Watch = watch) -> bool:
            ledger = state.ledger
            return watch.is_over(record.measurement.objective, ledger.rounds, ledger.num_bytes)

        run(method, case.problem, callback=is_over)
        rows.append(watch.row(remark=f"alpha {alpha:g}"))
    return min(rows, key=_preference)


def mesa(case: Case) -> dict[str, Any]:
    """MESA with the best of its penalties and multiplier steps."""
    start, ledger = case.chordal_start()
    rows: list[dict[str, Any]] = []
    for penalty, step in product(PENALTIES, MULTIPLIER_STEPS):
        watch = Watch(case.optimum, _rounds_of_best(rows))
        method = Mesa(
            case.robots,
            penalty,
            multiplier_step=step,
            tolerance=1e-12,
            max_iterations=MAX_ROUNDS,
        )

        def is_over(state: Any, record: Record, watch: Watch = watch) -> bool:
            rounds = ledger.rounds + state.ledger.rounds
            num_bytes = ledger.num_bytes + state.ledger.num_bytes
            return watch.is_over(record.measurement.objective, rounds, num_bytes)

        run(method, case.problem, start, callback=is_over)
        of_start = ledger.rounds, ledger.num_bytes
        rows.append(watch.row(start=of_start, remark=f"penalty {penalty:g}, step {step:g}"))
    return min(rows, key=_preference)


def _preference(row: dict[str, Any]) -> tuple[float, ...]:
    """Rounds to the levels, the finest first."""
    return tuple(math.inf if to is None else to[0] for to in reversed(row["levels"]))


def _rounds_of_best(rows: list[dict[str, Any]]) -> int:
    """Rounds after which another setting is no better, once the finest level was reached."""
    return int(min([_preference(row)[0] for row in rows] + [MAX_ROUNDS]))


METHODS: dict[str, Callable[[Case], dict[str, Any]]] = {
    "CONSENSUS": consensus,
    "CONSENSUS*": tuned_consensus,
    "SUBSTRUCTURED": substructured,
    "DGS": gauss_seidel,
    "MESA": mesa,
}


def table(names: list[str], robot_counts: list[int], methods: list[str]) -> Table:
    """Rounds and bytes of every method on every graph."""
    heads = [f"{level:.0e}".replace("e-0", "e-") for level in LEVELS]
    columns = ("graph", "robots", "method", "start", *heads, "proof", "CPU s", "remark")
    printed = Table(*columns, box=MARKDOWN)
    for name in names:
        for robots in robot_counts:
            for method in methods:
                row = child(name, str(robots), method)
                cells = [as_text(to) for to in [row.get("start"), *row["levels"], row["proof"]]]
                seconds = f"{row['seconds']:.1f}"
                printed.add_row(name, str(robots), method, *cells, seconds, row.get("remark", ""))
    return printed


def as_text(to: list[int] | None) -> str:
    """Rounds and bytes."""
    if to is None:
        return "-"
    rounds, num_bytes = to
    return f"{rounds}, {num_bytes / 1e3:.0f} kB"


def child(*arguments: str) -> dict[str, Any]:
    """Figures of a row in a process of its own."""
    command = [sys.executable, __file__, "--job", *arguments]
    finished = subprocess.run(command, capture_output=True, text=True, check=True)
    figures: dict[str, Any] = json.loads(finished.stdout)
    return figures


def main() -> None:
    """Print the table, or the figures of one row."""
    if sys.argv[1:2] == ["--job"]:
        name, robots, method = sys.argv[2:]
        print(json.dumps(METHODS[method](Case.of(name, int(robots)))))
        return
    parser = argparse.ArgumentParser(description="Print the table of distributed methods.")
    parser.add_argument("graphs", nargs="*", default=GRAPHS)
    parser.add_argument("--robots", default="5,25,50")
    parser.add_argument("--methods", default=",".join(METHODS))
    arguments = parser.parse_args()
    methods = arguments.methods.split(",")
    robot_counts = [int(count) for count in arguments.robots.split(",")]
    Console(width=160).print(table(list(arguments.graphs), robot_counts, methods))


if __name__ == "__main__":
    main()
