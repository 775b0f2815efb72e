"""Algorithm 1 with the paper's own rule of rho and stopping test beside the defaults here, on the
paper's scenes.

    python tests/benchmarks/paper_rule.py [DRAWS]

Every draw starts at its estimate by GPS and IMU, one pose a robot, at most 500 iterations. The gap
is that of the last iterate, with the best translations for it, to the certified optimum, without a
second stage: the best rotations of the first stage are a few percent above it themselves.
"""

from __future__ import annotations

import sys

import numpy as np

import pgo_models as pgo
import solvers
from solvers.soc.paper import PaperState
from solvers.soc.penalty import BoydPenalty

SCENES = {"circle": pgo.circle, "grid": pgo.grid, "sphere": pgo.sphere}
METHODS = {
    "default: relative residuals, first rho 0.3 m_i": solvers.PaperSOC(),
    "relative residuals, first rho m_i": solvers.PaperSOC(penalty=solvers.BalancedPenalty(1.0)),
    "as published: the paper's rule, first rho m_i, FISTA, p_res alone": (
        solvers.PaperSOC.as_published()
    ),
    **{
        f"the paper's rule, first rho {scale:g} m_i": solvers.PaperSOC(penalty=BoydPenalty(scale))
        for scale in (0.1, 1.0, 10.0, 100.0)
    },
}


def main() -> None:
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    print(
        "| scene | method | ended | iterations | rho, last over first | gap of the last iterate |"
    )
    print("|---|---|---|---|---|---|")
    for scene, draw in SCENES.items():
        graphs = [draw(np.random.default_rng(seed)) for seed in range(draws)]
        bounds = [solvers.solve(graph, progress=False).lower_bound for graph in graphs]
        for name, method in METHODS.items():
            print(row(scene, name, method, graphs, bounds), flush=True)


def row(
    scene: str,
    name: str,
    method: solvers.PaperSOC,
    graphs: list[pgo.PoseGraph],
    bounds: list[float],
) -> str:
    """A row of the table: medians over the draws, the gap with its range."""
    ended = 0
    iterations = []
    moved = []
    gaps = []
    for graph, bound in zip(graphs, bounds, strict=True):
        problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.ISOTROPIC)
        states: list[PaperState] = []
        result = solvers.run(
            method, problem, graph.initial, callback=lambda state, _, to=states: to.append(state)
        )
        ended += result.status is solvers.Status.CONVERGED
        iterations.append(result.iterations)
        moved.append(states[-1].rho / states[0].rho)
        gaps.append(100.0 * (method.measure(problem, states[-1]).objective / bound - 1.0))
    middle = f"{np.median(gaps):.3g} % ({min(gaps):.3g} to {max(gaps):.3g})"
    cells = (
        f"{ended} of {len(graphs)}",
        f"{np.median(iterations):.0f}",
        f"{np.median(moved):.3g}",
        middle,
    )
    return "| " + " | ".join([scene, name, *cells]) + " |"


if __name__ == "__main__":
    main()
