"""Methods on the problems of `pgo_models`: every one is settings with init, step, measure and converged."""

import importlib

# Public names, room by room, with the module that is imported when one of them is first used; types are in the stub.
_NAMES = {
    "solvers.result": "History Measurement Record Run Stage Status",
    "solvers.loop": "Method Solver iterate run",
    "solvers.pipeline": "Pipeline solve",
    "solvers.solution": "Solution",
    "solvers.folder_solve": "FolderSolution solve_folder",
    "solvers.growing": "extend",
    "solvers.reporting.report": "write_report",
    "solvers.soc.soc": "SOC",
    "solvers.soc.anderson": "Anderson",
    "solvers.soc.settings": "Coupling",
    "solvers.soc.paper": "PaperSOC",
    "solvers.soc.r_step": "CvxpyStep RStep",
    "solvers.soc.penalty": "BalancedPenalty BoydPenalty FixedPenalty MultiplierPenalty",
    "solvers.riemannian.newton": "Newton gauss_newton",
    "solvers.riemannian.staircase": "Staircase",
    "solvers.robust.gnc": "GNC RobustLoss",
    "solvers.robust.irls": "IRLS",
    "solvers.robust.consistency": "PCM pairwise_consistent",
    "solvers.baselines.gauss_seidel": "GaussSeidel",
    "solvers.baselines.levenberg_marquardt": "LevenbergMarquardt",
    "solvers.distributed.checkpoint": "Checkpoint",
    "solvers.network.faults": "Faults",
    "solvers.network.engine": "InProcess",
    "solvers.network.ledger": "Ledger",
    "solvers.network.ray_engine": "RayEngine",
    "solvers.convex.bregman": "AlternatingBregman Bregman MethodOfMultipliers TwoLineBregman",
    "solvers.convex.extended_soc": "ExtendedSOC",
    "solvers.convex.orthogonal": "OrthogonalSOC solve_orthogonal",
    "solvers.studies.comparison": "compare_methods",
    "solvers.studies.paper_figures": "draw_paper_figures",
    "solvers.studies.forgetting": "error_forgetting",
    "solvers.studies.tightness": "noise_sweep",
    "solvers.studies.paper_tables": "reproduce_tables",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = list(_MODULES)


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'solvers' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
