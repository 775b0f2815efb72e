"""Methods on the problems of `pgo_models`: every one is settings with init, step, measure and converged."""

from solvers.acceleration import Anderson
from solvers.loop import Solver, iterate, run
from solvers.newton import Newton, gauss_newton
from solvers.penalty import BalancedPenalty, FixedPenalty, MultiplierPenalty
from solvers.pipeline import Pipeline, solve
from solvers.result import History, Measurement, Record, Run, Status
from solvers.rotation_step import RStep
from solvers.soc import SOC, Coupling
from solvers.solution import Solution, Stage

__all__ = [
    "SOC",
    "Anderson",
    "BalancedPenalty",
    "Coupling",
    "FixedPenalty",
    "History",
    "Measurement",
    "MultiplierPenalty",
    "Newton",
    "Pipeline",
    "RStep",
    "Record",
    "Run",
    "Solution",
    "Solver",
    "Stage",
    "Status",
    "gauss_newton",
    "iterate",
    "run",
    "solve",
]
