from solvers.baselines.gauss_seidel import GaussSeidel
from solvers.baselines.levenberg_marquardt import LevenbergMarquardt
from solvers.convex.bregman import AlternatingBregman, Bregman, MethodOfMultipliers, TwoLineBregman
from solvers.convex.extended_soc import ExtendedSOC
from solvers.convex.orthogonal import OrthogonalSOC, solve_orthogonal
from solvers.distributed.checkpoint import Checkpoint
from solvers.folder_solve import FolderSolution, solve_folder
from solvers.growing import extend
from solvers.loop import Method, Solver, iterate, run
from solvers.network.engine import InProcess
from solvers.network.faults import Faults
from solvers.network.ledger import Ledger
from solvers.network.ray_engine import RayEngine
from solvers.pipeline import Pipeline, solve
from solvers.reporting.report import write_report
from solvers.result import History, Measurement, Record, Run, Stage, Status
from solvers.riemannian.newton import Newton, gauss_newton
from solvers.riemannian.staircase import Staircase
from solvers.robust.consistency import PCM, pairwise_consistent
from solvers.robust.gnc import GNC, RobustLoss
from solvers.robust.irls import IRLS
from solvers.soc.anderson import Anderson
from solvers.soc.paper import PaperSOC
from solvers.soc.penalty import BalancedPenalty, BoydPenalty, FixedPenalty, MultiplierPenalty
from solvers.soc.r_step import CvxpyStep, RStep
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC
from solvers.solution import Solution
from solvers.studies.comparison import compare_methods
from solvers.studies.forgetting import error_forgetting
from solvers.studies.paper_figures import draw_paper_figures
from solvers.studies.paper_tables import reproduce_tables
from solvers.studies.tightness import noise_sweep

__all__ = ["History", "Measurement", "Method", "Record", "Run", "Solver", "Stage", "Status", "iterate", "run"]
__all__ += ["FolderSolution", "Pipeline", "Solution", "extend", "solve", "solve_folder", "write_report"]
__all__ += ["SOC", "Anderson", "Coupling", "CvxpyStep", "PaperSOC", "RStep"]
__all__ += ["BalancedPenalty", "BoydPenalty", "FixedPenalty", "MultiplierPenalty"]
__all__ += ["Newton", "Staircase", "gauss_newton"]
__all__ += ["GNC", "IRLS", "PCM", "RobustLoss", "pairwise_consistent"]
__all__ += ["GaussSeidel", "LevenbergMarquardt"]
__all__ += ["Checkpoint", "Faults", "InProcess", "Ledger", "RayEngine"]
__all__ += ["AlternatingBregman", "Bregman", "MethodOfMultipliers", "TwoLineBregman"]
__all__ += ["ExtendedSOC", "OrthogonalSOC", "solve_orthogonal"]
__all__ += ["compare_methods", "draw_paper_figures", "error_forgetting", "noise_sweep", "reproduce_tables"]
