"""Methods on the problems of `pgo_models`: every one is settings with init, step, measure and converged."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from solvers.acceleration import Anderson
from solvers.loop import Method, Solver, iterate, run, run_method
from solvers.newton import Newton, gauss_newton
from solvers.noise_sweep import NoiseSweep, SweptScene, noise_sweep, noisy_scene
from solvers.penalty import BalancedPenalty, FixedPenalty, MultiplierPenalty
from solvers.pipeline import Pipeline, solve
from solvers.result import History, Measurement, Outcome, Record, Run, Status
from solvers.rotation_step import CustomRStep, RStep
from solvers.soc import SOC, Coupling
from solvers.solution import Solution, Stage

if TYPE_CHECKING:
    from solvers.bregman import AlternatingBregman, Bregman, MethodOfMultipliers, TwoLineBregman, feasibility_bound
    from solvers.changed_soc import ChangedSOC, ChangedStep
    from solvers.error_forgetting import ErrorForgetting, error_forgetting
    from solvers.orthogonal_soc import OrthogonalSOC, OrthogonalSolution, solve_orthogonal

# These import cvxpy, which takes half of the time of an import: loaded when one of their names is first used.
_CVXPY_METHODS = {
    "ChangedSOC": "solvers.changed_soc",
    "ChangedStep": "solvers.changed_soc",
    "AlternatingBregman": "solvers.bregman",
    "Bregman": "solvers.bregman",
    "MethodOfMultipliers": "solvers.bregman",
    "TwoLineBregman": "solvers.bregman",
    "feasibility_bound": "solvers.bregman",
    "ErrorForgetting": "solvers.error_forgetting",
    "error_forgetting": "solvers.error_forgetting",
    "OrthogonalSOC": "solvers.orthogonal_soc",
    "OrthogonalSolution": "solvers.orthogonal_soc",
    "solve_orthogonal": "solvers.orthogonal_soc",
}

__all__ = [
    "SOC",
    "AlternatingBregman",
    "Anderson",
    "BalancedPenalty",
    "Bregman",
    "ChangedSOC",
    "ChangedStep",
    "Coupling",
    "CustomRStep",
    "ErrorForgetting",
    "FixedPenalty",
    "History",
    "Measurement",
    "Method",
    "MethodOfMultipliers",
    "MultiplierPenalty",
    "Newton",
    "NoiseSweep",
    "OrthogonalSOC",
    "OrthogonalSolution",
    "Outcome",
    "Pipeline",
    "RStep",
    "Record",
    "Run",
    "Solution",
    "Solver",
    "Stage",
    "Status",
    "SweptScene",
    "TwoLineBregman",
    "error_forgetting",
    "feasibility_bound",
    "gauss_newton",
    "iterate",
    "noise_sweep",
    "noisy_scene",
    "run",
    "run_method",
    "solve",
    "solve_orthogonal",
]


def __getattr__(name: str) -> object:
    if name not in _CVXPY_METHODS:
        raise AttributeError(f"module 'solvers' has no attribute {name!r}")
    value: object = getattr(importlib.import_module(_CVXPY_METHODS[name]), name)
    return value
