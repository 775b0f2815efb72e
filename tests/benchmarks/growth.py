"""How CPU seconds grow with the poses, 12,500 to 50,000: from file to certificate, on worlds of two
kinds.

    python tests/benchmarks/growth.py [lattice] [plane] [space]

Lattices have an edge between all neighbours, as the planar worlds that SE-Sync was timed on (22,801
poses and 45,300 edges are 151 rows of 151); `pgo generate grid-world` has 100 robots that meet. The
least of seven (in space of three), the two sizes in turn, reading included, imports and the first
solve of a process apart. An exponent a stands for seconds in proportion to n^a.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
import time
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"

import numpy as np

import pgo_models as pgo
import solvers
from pgo_models.graphs.scenes import MILD_NOISE, observe

RUNS = {"lattice": 7, "plane": 7, "space": 3}
SEEDS = {"lattice": 3, "plane": 5, "space": 2}
HEAD = "| world | edges a pose | CPU s | exponent |\n|---|---|---|---|"


def lattice(side: int, seed: int) -> pgo.PoseGraph:
    """Planar world of side x side poses, 1 m apart, row by row to and fro, with edges between all
    neighbours.
    """
    rng = np.random.default_rng(seed)
    number = np.arange(side * side).reshape(side, side)
    number[1::2] = number[1::2, ::-1].copy()
    t = np.empty((side * side, 2))
    t[number.ravel()] = np.indices((side, side)).reshape(2, -1).T
    pairs = [(number[:, :-1], number[:, 1:]), (number[:-1], number[1:])]
    i, j = np.sort(
        np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs]), axis=1
    ).T
    truth = pgo.Poses(pgo.random_rotations(side * side, 2, rng), t)
    return observe("lattice", truth, i, j, MILD_NOISE, MILD_NOISE.kappa(2), MILD_NOISE.tau, rng)


def grid_world(d: int, poses: int, seed: int) -> pgo.PoseGraph:
    """World of 100 robots."""
    return pgo.grid_world(100, poses // 100, np.random.default_rng(seed), d=d)


def seconds(path: Path) -> float:
    """CPU seconds from the file to the certificate."""
    began = time.process_time()
    solution = solvers.solve(
        pgo.PGOProblem(pgo.read_g2o(path), weighting=pgo.Weighting.ISOTROPIC), progress=False
    )
    found = time.process_time() - began
    assert solution.is_certified
    return found


def main() -> None:
    kinds = {
        "lattice": (lambda seed: [lattice(side, seed) for side in (112, 224)]),
        "plane": (lambda seed: [grid_world(2, poses, seed) for poses in (12_500, 50_000)]),
        "space": (lambda seed: [grid_world(3, poses, seed) for poses in (12_500, 50_000)]),
    }
    print(HEAD, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for kind in sys.argv[1:] or list(kinds):
            worlds = kinds[kind]
            exponents = []
            for seed in range(SEEDS[kind]):
                graphs = worlds(seed)
                paths = [Path(folder) / f"{k}.g2o" for k in range(2)]
                n = [graph.num_poses for graph in graphs]
                for graph, path in zip(graphs, paths, strict=True):
                    pgo.write_g2o(graph, path)
                seconds(paths[0])
                small, large = np.min(
                    [[seconds(path) for path in paths] for _ in range(RUNS[kind])], axis=0
                )
                exponents.append(math.log(large / small) / math.log(n[1] / n[0]))
                name = f"{kind}, {n[0]} and {n[1]} poses"
                share = graphs[1].num_edges / n[1]
                print(
                    f"| {name} | {share:.2f} | {small:.2f}, {large:.2f} | {exponents[-1]:.2f} |",
                    flush=True,
                )
            print(f"| {kind}: mean | | | {np.mean(exponents):.2f} |", flush=True)


if __name__ == "__main__":
    main()
