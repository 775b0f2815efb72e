"""A log read edge by edge: every thousand edges `extend` goes on from the solution before, beside a solve afresh.

    python tests/benchmarks/growing.py [FILE ..]

CPU seconds, the least of three; both without reading.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import pgo_models as pgo
import solvers

NAMES, STEP, RUNS = ("manhattan", "torus3D"), 1000, 3
ROW = "| {} | {} | {} | {:.3f} | {:.3f} | {:.2f} | {:.1e} |"


def prefixes(graph: pgo.PoseGraph) -> list[pgo.PoseGraph]:
    """The graph after every thousand edges, in the order of the later pose of each."""
    later = np.maximum(graph.i, graph.j)
    order = np.argsort(later, kind="stable")
    found = []
    for count in [*range(STEP, graph.num_edges, STEP), graph.num_edges]:
        is_in = np.zeros(graph.num_edges, dtype=bool)
        is_in[order[:count]] = True
        so_far = graph.without_edges(~is_in)
        found.append(so_far.subgraph(np.arange(later[order[count - 1]] + 1)))
    return found


def timed(solve: Callable[[], solvers.Solution]) -> tuple[float, solvers.Solution]:
    """Least CPU seconds, and the solution."""
    seconds = []
    for _ in range(RUNS):
        began = time.process_time()
        solution = solve()
        seconds.append(time.process_time() - began)
    return min(seconds), solution


def main() -> None:
    folder = Path(os.environ.get("PGO_DATA", "."))
    print("| graph | poses | edges | afresh, s | extended, s | share | gap |\n|---|---|---|---|---|---|---|")
    for path in [Path(name) for name in sys.argv[1:]] or [folder / f"{name}.g2o" for name in NAMES]:
        graph, before, spent = pgo.read_g2o(path), None, np.zeros(2)
        for part in prefixes(graph):
            afresh, solution = timed(lambda part=part: solvers.solve(part, progress=False))
            if before is not None:
                seconds, grown = timed(lambda part=part, before=before: solvers.extend(before, part))
                assert grown.objective <= solution.objective * (1.0 + 1e-9)
                figures = part.num_poses, part.num_edges, afresh, seconds, seconds / afresh, grown.gap
                print(ROW.format(path.stem, *figures), flush=True)
                spent += seconds, afresh
            before = solution
        print(f"{path.stem}: {spent[0] / spent[1]:.2f} of the time afresh in all")


if __name__ == "__main__":
    main()
