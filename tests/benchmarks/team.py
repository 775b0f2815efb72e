"""Bytes of all messages of a team, by what it shares, beside the size of its files.

    python tests/benchmarks/team.py [NAME ..]

Robots in this process exchange messages at once (`tests/networks.py`). Files are those that
`write_g2o_folder` writes, with all digits of the doubles.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
from networks import KEY, Network

import pgo_models as pgo
import solvers
from pgo_models.graphs.g2o import write_g2o_folder

CASES = (("robots", 4), ("example_4robots", 4), ("smallGrid3D", 5), ("intel", 5), ("kitti_07", 5))


def files_of(name: str, num_robots: int, folder: Path) -> list[Path]:
    """A g2o file for every robot."""
    graph = pgo.load(name)
    if graph.num_robots != num_robots:
        graph = graph.with_robots(pgo.partition(graph, num_robots).robot)
    write_g2o_folder(graph, folder)
    return sorted(folder.glob("*.g2o"))


def carried(files: list[Path], sharing: solvers.Sharing) -> tuple[int, int]:
    """Bytes and rounds of a solve."""
    names = [f"r{k:02}" for k in range(len(files))]
    robots = {}
    for name, path in zip(names, files, strict=True):
        robots[name] = solvers.Robot(name, names, KEY, sharing=sharing)
        robots[name].read(path)
    network = Network(robots, np.random.default_rng(0), delay=1e-3)
    network.run(300.0)
    network.wait(3.0)
    solution = robots[names[0]].solution
    assert solution is not None
    assert solution.is_certified, str(solution)
    return network.carried, solution.ledger.rounds


def main() -> None:
    cases = [case for case in CASES if case[0] in sys.argv[1:] or len(sys.argv) == 1]
    for name, num_robots in cases:
        with tempfile.TemporaryDirectory() as folder:
            files = files_of(name, num_robots, Path(folder))
            size = sum(path.stat().st_size for path in files)
            cells = [name, str(num_robots), f"{size / 1e3:.0f}"]
            for sharing in solvers.Sharing:
                num_bytes, rounds = carried(files, sharing)
                cells.append(f"{num_bytes / 1e3:.0f}, {rounds}")
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
