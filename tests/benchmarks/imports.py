"""What whole commands cost in CPU time, and what they import: multiples of importing numpy and
scipy.sparse.linalg.

    python tests/benchmarks/imports.py
    python tests/benchmarks/imports.py solve sphere

The first command prints a table of commands. The second prints what one command, here `pgo solve
sphere`, imports beyond numpy and scipy.sparse.linalg, by packages, as `-X importtime` has it. CPU
seconds are those of user and system, of interpreters of their own: the least of ten, one after the
other in turn, with one thread and with the bytecode compiled before, as of an installed package. MB
are the largest resident memory of that run.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

RUNS = 10
MOST_PACKAGES = 15
ROOT = Path(__file__).parents[2]
BASE = "import numpy, scipy.sparse.linalg"
DOORS = f"{BASE}; import pgo_models, solvers"
# As the script that an installer writes.
ENTRY = "import sys; from solvers.cli.app import main; sys.argv[0] = 'pgo'; sys.exit(main())"
STATEMENTS = {
    "`import numpy, scipy.sparse.linalg`": BASE,
    "... and `pgo_models, solvers`": DOORS,
    "... with `solvers.solve`": f"{DOORS}; solvers.solve, pgo_models.PGOProblem",
}
COMMANDS = (
    "--version",
    "--help",
    "solve --help",
    "info sphere",
    "certify sphere",
    "solve sphere",
    "solve sphere --robots 5",
)
LARGE = ("torus3D", "cubicle", "city10000")  # where PGO_DATA has them


def environment(folder: str) -> dict[str, str]:
    """Variables of an interpreter with the packages of this copy, compiled into a folder."""
    variables = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join((str(ROOT), folder)),
        "PYTHONPYCACHEPREFIX": str(Path(folder, "bytecode")),
    }
    variables.pop("PYTHONDONTWRITEBYTECODE", None)
    return variables


def costs(arguments: list[str], variables: dict[str, str]) -> tuple[float, float]:
    """CPU seconds, of user and system, and MB of one interpreter, whose command has to end well."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen([sys.executable, *arguments], env=variables, **quiet)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 3):  # 3: no certificate
        sys.exit(f"{shlex.join(arguments)} ended with {process.returncode}")
    return usage.ru_utime + usage.ru_stime, 1e-3 * usage.ru_maxrss


def import_times(arguments: list[str], variables: dict[str, str]) -> dict[str, float]:
    """Seconds of every module that an interpreter imports, without those it imports in turn."""
    finished = subprocess.run(
        [sys.executable, "-X", "importtime", *arguments],
        env=variables,
        capture_output=True,
        text=True,
        check=False,
    )
    times: dict[str, float] = {}
    for line in finished.stderr.splitlines():
        own, bar, rest = line.removeprefix("import time:").partition("|")
        if line.startswith("import time:") and bar and own.strip().isdecimal():
            times[rest.partition("|")[2].strip()] = 1e-6 * int(own)
    return times


def room_of(module: str) -> str:
    """Room of a module of this project, or its package."""
    package, *rest = module.split(".")
    is_divided = package in ("pgo_models", "solvers", "scipy") and rest
    return f"{package}.{rest[0]}" if is_divided else package


def print_commands(variables: dict[str, str]) -> None:
    """Print the table of commands."""
    large = [
        name for name in LARGE if Path(os.environ.get("PGO_DATA", ""), f"{name}.g2o").is_file()
    ]
    rows = {name: ["-c", code] for name, code in STATEMENTS.items()}
    for command in (*COMMANDS, *(f"solve {name} --cost isotropic" for name in large)):
        rows[f"`pgo {command}`"] = ["-c", ENTRY, *shlex.split(command)]
    modules = {name: len(import_times(row, variables)) for name, row in rows.items()}
    runs = [[costs(row, variables) for row in rows.values()] for _ in range(RUNS)]
    least = [min(column) for column in zip(*runs, strict=True)]
    first = least[0][0]
    print("| command | CPU s | multiple of the first | MB | modules |\n|---|---|---|---|---|")
    for name, (time, megabytes) in zip(rows, least, strict=True):
        figures = f"{time:.3f} | {time / first:.2f} | {megabytes:.0f} | {modules[name]}"
        print(f"| {name} | {figures} |")


def print_imports(command: list[str], variables: dict[str, str]) -> None:
    """Print what a command imports beyond numpy and scipy.sparse.linalg."""
    rows = [["-c", BASE], ["-c", ENTRY, *command]]
    for row in rows:
        costs(row, variables)  # compiles
    base, times = (import_times(row, variables) for row in rows)
    spent: Counter[str] = Counter()
    count: Counter[str] = Counter()
    for module in times.keys() - base.keys():
        spent[room_of(module)] += times[module]
        count[room_of(module)] += 1
    print("| of `-X importtime` | modules | ms |\n|---|---|---|")
    for room, time in spent.most_common(MOST_PACKAGES):
        print(f"| {room} | {count[room]} | {1e3 * time:.1f} |")
    print(f"| all | {sum(count.values())} | {1e3 * sum(spent.values()):.1f} |")


def main() -> None:
    command = sys.argv[1:]
    with tempfile.TemporaryDirectory() as folder:
        variables = environment(folder)
        if command:
            print_imports(command, variables)
        else:
            print_commands(variables)


if __name__ == "__main__":
    main()
