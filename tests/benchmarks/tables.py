"""Prints the tables of one robot (README.md beside this file): the whole job beside SE-Sync, and
SOC's iterations.

    PGO_DATA=folder python tests/benchmarks/tables.py [solve] [iterations]
    PGO_DATA=folder python tests/benchmarks/tables.py --beside CHECKOUT

Every graph of the first table runs in a process of its own, one thread: a first job, then five
more; imports are apart. Where the environment variable SE_SYNC names the binary of SE-Sync (C++),
which takes a g2o file, it runs on every file as often, and the last columns have the CPU seconds of
its whole process, and over them ours without imports, which is not like for like, and those of a
whole process of `pgo solve`, which is. Last the kernels of every BLAS are named (`pip install
threadpoolctl`).

Without the binary: it was timed once, the whole process, in one run with commit 032ba88 of this
project (data/reference.json). `--beside` runs a checkout of that commit (`git worktree add CHECKOUT
032ba88`) in turn with this tree, which gives SE-Sync's.
"""

import importlib.util
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"

from rich.console import Console
from rich.table import Table
from unit import seconds_of_unit

import pgo_models as pgo
import solvers

REFERENCE = json.loads((Path(__file__).parents[2] / "data" / "reference.json").read_text())
OPTIMUM = {
    name: value for name, value in REFERENCE["certified_optimum"].items() if name != "source"
}
SE_SYNC = REFERENCE["peers"]["se_sync_units"]
TIMED_ONCE = {
    name: row for name, row in REFERENCE["peers"]["se_sync_cpu"].items() if name != "source"
}
ITERATIONS = REFERENCE["peers"]["prototype_iterations_to_1e-6"]
BINARY = os.environ.get("SE_SYNC")
REPEATS = 5
ROUNDS = 7  # of a process of each tree
MAX_ITERATIONS = 400


def solve_in_F(name: str) -> "solvers.Solution":
    """Read a graph, solve and certify it; commit 032ba88 has no other cost, and no `Weighting`."""
    path = Path(os.environ["PGO_DATA"]) / f"{name}.g2o"
    weighting = getattr(pgo, "Weighting", None)
    cost = {} if weighting is None else {"weighting": weighting.ISOTROPIC}
    return solvers.solve(pgo.PGOProblem(pgo.read_g2o(path), **cost))


def one_job(name: str) -> None:
    """Read, solve and certify a graph 1 + REPEATS times; print the figures as JSON."""
    solvers.solve(pgo.load("grid"))  # import time is apart
    seconds = []
    cpu = []
    for _ in range(1 + REPEATS):
        begin = time.perf_counter()
        began = time.process_time()
        solution = solve_in_F(name)
        seconds.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - began)
    figures = {
        "cpu": min(cpu),
        "first": seconds[0],
        "median": statistics.median(seconds[1:]),
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "objective": solution.objective,
        "cost": solution.certificate.cost_text,
        "gap": solution.certificate.proven_gap,
        "verdict": solution.certificate.verdict.name,
        "soc": sum(stage.iterations for stage in solution.stages if stage.name == "SOC"),
        "newton": sum(stage.iterations for stage in solution.stages if stage.name == "Newton"),
    }
    print(json.dumps(figures))


def cpu_job(name: str) -> None:
    """Print the least CPU seconds of `solve_in_F`, which commit 032ba88 has as well."""
    solvers.solve(pgo.load("grid"))  # import time is apart
    cpu = []
    for _ in range(1 + REPEATS):
        began = time.process_time()
        solve_in_F(name)
        cpu.append(time.process_time() - began)
    print(min(cpu))


def answer_of(job: str, name: str, **variables: str) -> Any:
    """What a job prints in a process of its own, with these environment variables besides."""
    run = [sys.executable, __file__, job, name]
    child = subprocess.run(
        run, capture_output=True, text=True, check=True, env={**os.environ, **variables}
    )
    return json.loads(child.stdout)


def process_seconds(*command: str) -> float:
    """CPU seconds of a whole process, the least of `REPEATS`."""
    least = float("inf")
    for _ in range(REPEATS):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, capture_output=True, check=True, env=os.environ)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        least = min(least, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return least


def kernels_in_use() -> str:
    """Kernels of every BLAS of this process after a solve, with the versions, by who brings it."""
    solvers.solve(pgo.load("grid"))
    if importlib.util.find_spec("threadpoolctl") is None:
        return "BLAS kernels: not known without threadpoolctl"
    found = importlib.import_module("threadpoolctl").threadpool_info()
    of_blas = [one for one in found if one["user_api"] == "blas"]
    named = [
        f"{Path(one['filepath']).parent.name}: {one['version']}, {one['architecture']}"
        for one in of_blas
    ]
    return "BLAS kernels: " + "; ".join(named)


def solve_table() -> Table:
    """Whole job, file to certificate."""
    from pgo_models.figures import rounded_up  # which commit 032ba88 does not have

    heads = [
        "graph",
        "F",
        "off by",
        "gap",
        "SOC",
        "Newton",
        "first (s)",
        "median (s)",
        "u",
        "SE-Sync (u)",
        "MB",
    ]
    table = Table(
        *heads, *["SE-Sync, CPU s", "ours, no imports", "pgo solve"] * (BINARY is not None)
    )
    pgo_solve = (
        sys.executable,
        "-c",
        "from solvers.cli.app import main; main()",
        "solve",
        "--quiet",
    )
    ratios = []
    of_processes = []
    for name in OPTIMUM:
        unit = seconds_of_unit()
        row = answer_of("--job", name)
        peer = SE_SYNC.get(name)
        beside = []
        if BINARY is not None:
            path = str(Path(os.environ["PGO_DATA"]) / f"{name}.g2o")
            theirs = process_seconds(BINARY, path)
            ratios.append(row["cpu"] / theirs)
            of_processes.append(process_seconds(*pgo_solve, path) / theirs)
            beside = [f"{theirs:.3f}", f"{ratios[-1]:.2f}", f"{of_processes[-1]:.2f}"]
        table.add_row(
            name,
            row["cost"],
            f"{abs(row['objective'] - OPTIMUM[name]) / OPTIMUM[name]:.0e}",
            f"{rounded_up(row['gap'], 2)}"
            f" {'' if row['verdict'] == 'CERTIFIED' else row['verdict']}",
            str(row["soc"]),
            str(row["newton"]),
            f"{row['first']:.3f}",
            f"{row['median']:.3f}",
            f"{row['median'] / unit:.2f}",
            "-" if peer is None else f"{peer:.2f}",
            f"{row['memory']:.0f}",
            *beside,
        )
    if ratios:
        means = [statistics.geometric_mean(found) for found in (ratios, of_processes)]
        table.caption = (
            f"geometric means over SE-Sync's process: {means[0]:.2f}, whole processes"
            f" {means[1]:.2f}"
        )
    return table


def beside_table(checkout: str) -> Table:
    """CPU seconds, file to certificate, and over those of SE-Sync, by those of commit 032ba88
    beside both.
    """
    table = Table("graph", "CPU s", "032ba88, CPU s", "over SE-Sync's")
    ratios = []
    for name, (before, theirs) in TIMED_ONCE.items():
        least = dict.fromkeys((str(Path(__file__).parents[2]), checkout), float("inf"))
        for tree in [*least] * ROUNDS:
            least[tree] = min(least[tree], answer_of("--cpu", name, PYTHONPATH=tree))
        here, then = least.values()
        ratios.append(here / then * before / theirs)
        table.add_row(name, f"{here:.4f}", f"{then:.4f}", f"{ratios[-1]:.2f}")
    table.caption = f"geometric mean over SE-Sync's: {statistics.geometric_mean(ratios):.3f}"
    return table


def iterations_table() -> Table:
    """Iterations of JOINT SOC from the chordal start, default settings, to three relative gaps."""
    table = Table("graph", "start", "1e-3", "1e-6", "1e-8", "prototype, 1e-6")
    for name in ITERATIONS:
        problem = pgo.PGOProblem(pgo.load(name), weighting=pgo.Weighting.ISOTROPIC)
        run = solvers.run(solvers.SOC(tolerance=1e-9, max_iterations=MAX_ITERATIONS), problem)
        gaps = (run.history.objective - OPTIMUM[name]) / max(1.0, OPTIMUM[name])
        cells = [
            next((str(k) for k, gap in enumerate(gaps) if gap <= level), "-")
            for level in (1e-3, 1e-6, 1e-8)
        ]
        table.add_row(name, f"{gaps[0]:.1e}", *cells, str(ITERATIONS[name]))
    return table


TABLES = {"solve": solve_table, "iterations": iterations_table}

if __name__ == "__main__":
    if sys.argv[1:2] == ["--job"]:
        one_job(sys.argv[2])
    elif sys.argv[1:2] == ["--cpu"]:
        cpu_job(sys.argv[2])
    elif sys.argv[1:2] == ["--beside"]:
        Console(width=130).print(beside_table(sys.argv[2]))
    else:
        for chosen in sys.argv[1:] or TABLES:
            print(TABLES[chosen].__doc__)
            Console(width=130).print(TABLES[chosen]())
        print(kernels_in_use())
