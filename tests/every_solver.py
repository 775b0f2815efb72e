"""One of every solver, for tests of what all of them promise."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pgo_models as pgo
import solvers
from solvers.riemannian.prefixes import GrowingStart

Make = Callable[..., Any]


def three_robots(problem: pgo.PGOProblem, **changes: Any) -> solvers.SOC:
    return solvers.SOC(robots=pgo.partition(problem.graph, min(3, problem.num_poses)), **changes)


def singletons(problem: pgo.PGOProblem, **changes: Any) -> solvers.SOC:
    return solvers.SOC(
        robots=pgo.partition(problem.graph, method=pgo.PartitionMethod.SINGLETONS), **changes
    )


SOLVERS: dict[str, Make] = {
    "soc_joint": lambda problem, **changes: solvers.SOC(**changes),
    "soc_joint_plain": lambda problem, **changes: solvers.SOC(
        acceleration=None, alpha=1.5, **changes
    ),
    "soc_joint_balanced": lambda problem, **changes: solvers.SOC(
        penalty=solvers.BalancedPenalty(), **changes
    ),
    "soc_consensus": three_robots,
    "soc_consensus_singletons": singletons,
    "soc_paper": lambda problem, **changes: solvers.PaperSOC(**changes),
    "soc_paper_one_robot": lambda problem, **changes: solvers.PaperSOC(
        robots=pgo.partition(problem.graph, 1), **changes
    ),
    "gauss_seidel": lambda problem, **changes: solvers.GaussSeidel(
        robots=pgo.partition(problem.graph, min(3, problem.num_poses)), **changes
    ),
    "gauss_seidel_singletons": lambda problem, **changes: solvers.GaussSeidel(
        alpha=1.2, gauss_newton_steps=3, **changes
    ),
    "newton": lambda problem, **changes: solvers.Newton(**changes),
    "gauss_newton": lambda problem, **changes: replace(solvers.gauss_newton(), **changes),
    "staircase": lambda problem, **changes: solvers.Staircase(**changes),
    "growing_start": lambda problem, **changes: GrowingStart(first_size=2, growth=0.1, **changes),
    "gnc": lambda problem, **changes: solvers.GNC(spread=None, **changes),
    "gnc_geman_mcclure": lambda problem, **changes: solvers.GNC(
        solvers.RobustLoss.GEMAN_MCCLURE, spread=None, **changes
    ),
}
