"""Methods on the problems of `pgo_models`: every one is settings with init, step, measure and converged."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from solvers.acceleration import Anderson
from solvers.checkpoint import Checkpoint
from solvers.comparison import Comparison, ComparisonSettings, compare_methods
from solvers.comparison_plots import explore_efforts, plot_efforts
from solvers.convergence_plots import Curve, Effort, explore_convergence, plot_convergence, plot_gaps
from solvers.engine import InProcess
from solvers.gauss_seidel import DGSStage, GaussSeidel
from solvers.gtsam_rival import Gtsam, GtsamMethod, run_gtsam
from solvers.levenberg_marquardt import LevenbergMarquardt
from solvers.loop import Method, Solver, iterate, run, run_method
from solvers.network import Faults, Ledger, Traffic
from solvers.newton import Newton, gauss_newton
from solvers.noise_sweep import NoiseSweep, SweptScene, noise_sweep, noisy_scene
from solvers.paper_figures import FigureSet, draw_paper_figures
from solvers.penalty import BalancedPenalty, BoydPenalty, FixedPenalty, MultiplierPenalty
from solvers.pipeline import Pipeline, solve
from solvers.ray_engine import RayEngine
from solvers.recovery import Recovery
from solvers.report import write_report
from solvers.reproduction import Reproduction, ReproductionSettings, reproduce_tables
from solvers.reproduction_text import Finding, findings, tables_as_text
from solvers.result import History, Measurement, Outcome, Record, Run, Stage, Status
from solvers.rotation_step import CustomRStep, RStep
from solvers.schedule import Sweep
from solvers.soc import SOC, Coupling
from solvers.solution import Solution
from solvers.staircase import Staircase
from solvers.table_formats import ResultTable
from solvers.trial_runs import run_trial
from solvers.trials import Contender, Trial, TrialSettings

if TYPE_CHECKING:
    from solvers.bregman import AlternatingBregman, Bregman, MethodOfMultipliers, TwoLineBregman, feasibility_bound
    from solvers.changed_soc import ChangedSOC, ChangedStep
    from solvers.forgetting import ErrorForgetting, error_forgetting
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
    "ErrorForgetting": "solvers.forgetting",
    "error_forgetting": "solvers.forgetting",
    "OrthogonalSOC": "solvers.orthogonal_soc",
    "OrthogonalSolution": "solvers.orthogonal_soc",
    "solve_orthogonal": "solvers.orthogonal_soc",
}

__all__ = [
    "SOC",
    "AlternatingBregman",
    "Anderson",
    "BalancedPenalty",
    "BoydPenalty",
    "Bregman",
    "ChangedSOC",
    "ChangedStep",
    "Checkpoint",
    "Comparison",
    "ComparisonSettings",
    "Contender",
    "Coupling",
    "Curve",
    "CustomRStep",
    "DGSStage",
    "Effort",
    "ErrorForgetting",
    "Faults",
    "FigureSet",
    "Finding",
    "FixedPenalty",
    "GaussSeidel",
    "Gtsam",
    "GtsamMethod",
    "History",
    "InProcess",
    "Ledger",
    "LevenbergMarquardt",
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
    "RayEngine",
    "Record",
    "Recovery",
    "Reproduction",
    "ReproductionSettings",
    "ResultTable",
    "Run",
    "Solution",
    "Solver",
    "Stage",
    "Staircase",
    "Status",
    "Sweep",
    "SweptScene",
    "Traffic",
    "Trial",
    "TrialSettings",
    "TwoLineBregman",
    "compare_methods",
    "draw_paper_figures",
    "error_forgetting",
    "explore_convergence",
    "explore_efforts",
    "feasibility_bound",
    "findings",
    "gauss_newton",
    "iterate",
    "noise_sweep",
    "noisy_scene",
    "plot_convergence",
    "plot_efforts",
    "plot_gaps",
    "reproduce_tables",
    "run",
    "run_gtsam",
    "run_method",
    "run_trial",
    "solve",
    "solve_orthogonal",
    "tables_as_text",
    "write_report",
]


def __getattr__(name: str) -> object:
    if name not in _CVXPY_METHODS:
        raise AttributeError(f"module 'solvers' has no attribute {name!r}")
    value: object = getattr(importlib.import_module(_CVXPY_METHODS[name]), name)
    return value
