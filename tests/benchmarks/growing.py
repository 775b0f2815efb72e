"""A log read edge by edge: every thousand edges `extend` goes on from its own last solution, beside
a solve afresh.

    python tests/benchmarks/growing.py [FILE ..]

CPU seconds, the least of three, the two in turn; both without reading. Beside them what no update
can do without: the certificate alone, of a new problem at the poses of its optimum.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import pgo_models as pgo
import solvers
from pgo_models.figures import rounded_up

NAMES = ("manhattan", "M3500", "city10000", "kitti_00", "sphere2500", "torus3D")
STEP = 1000
RUNS = 3
HEAD = (
    "| graph | poses | edges | afresh, s | extended, s | share | certificate's | gap |\n"
    + "|---" * 8
    + "|"
)
ROW = "| {} | {} | {} | {:.3f} | {:.3f} | {:.2f} | {:.2f} | {} |"


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


def seconds_of(solve: Callable[[], object]) -> float:
    """CPU seconds."""
    began = time.process_time()
    solve()
    return time.process_time() - began


def main() -> None:
    folder = Path(os.environ.get("PGO_DATA", "."))
    print(HEAD)
    for path in [Path(name) for name in sys.argv[1:]] or [folder / f"{name}.g2o" for name in NAMES]:
        parts = prefixes(replace(pgo.read_g2o(path), information=None))  # the cost is F
        times = []
        fallbacks = 0
        grown = solvers.solve(parts[0], progress=False)
        for part in parts[1:]:
            before = grown
            best = solvers.solve(part, progress=False)
            grown = solvers.extend(before, part)
            assert grown.is_certified
            assert grown.lower_bound <= best.objective
            ways = (
                lambda part=part: solvers.solve(part, progress=False),
                lambda part=part, before=before: solvers.extend(before, part),
                lambda part=part, best=best: pgo.certify_at(pgo.PGOProblem(part), best.poses),
            )
            least = np.min([[seconds_of(way) for way in ways] for _ in range(RUNS)], axis=0)
            shares = least[1:] / least[0]
            gap = rounded_up(grown.certificate.proven_gap, 2)
            print(
                ROW.format(path.stem, part.num_poses, part.num_edges, *least[:2], *shares, gap),
                flush=True,
            )
            times.append(least)
            fallbacks += len(grown.stages) > 2
        mean = np.mean([least[1:] / least[0] for least in times], axis=0)
        total = np.sum(times, axis=0)
        print(
            f"{path.stem}: {mean[0]:.2f} of the time afresh in the mean, {total[1] / total[0]:.2f}"
            f" in all, of which the certificate {total[2] / total[0]:.2f}; {fallbacks} of"
            f" {len(times)} updates needed the whole pipeline"
        )


if __name__ == "__main__":
    main()
