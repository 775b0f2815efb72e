from solvers.baselines.gauss_seidel import GaussSeidel as GaussSeidel
from solvers.carry.faults import Faults as Faults
from solvers.carry.process import (
    InProcess as InProcess,
)
from solvers.carry.ray_engine import RayEngine as RayEngine
from solvers.convex.bregman import (
    AlternatingBregman as AlternatingBregman,
    Bregman as Bregman,
    MethodOfMultipliers as MethodOfMultipliers,
    TwoLineBregman as TwoLineBregman,
)
from solvers.convex.extended_soc import ExtendedSOC as ExtendedSOC
from solvers.convex.orthogonal import OrthogonalSOC as OrthogonalSOC
from solvers.convex.solve_orthogonal import solve_orthogonal as solve_orthogonal
from solvers.growing import extend as extend
from solvers.loop import Solver as Solver, iterate as iterate, run as run
from solvers.pipeline import solve as solve
from solvers.report.report import write_report as write_report
from solvers.reporting.film import film as film
from solvers.request import Pipeline as Pipeline
from solvers.result import (
    Measurement as Measurement,
    Status as Status,
)
from solvers.riemannian.newton import Newton as Newton, gauss_newton as gauss_newton
from solvers.riemannian.polish import polish as polish
from solvers.riemannian.staircase import Staircase as Staircase
from solvers.robots.settings import Checkpoint as Checkpoint, Robots as Robots
from solvers.robust.consistency import PCM as PCM
from solvers.robust.gnc import GNC as GNC
from solvers.robust.irls import IRLS as IRLS
from solvers.robust.known import Known as Known
from solvers.robust.losses import RobustLoss as RobustLoss
from solvers.robust_solves.outlier_proof import prove_outliers as prove_outliers
from solvers.soc.paper import PaperSOC as PaperSOC
from solvers.soc.penalty import (
    BalancedPenalty as BalancedPenalty,
    FixedPenalty as FixedPenalty,
    MultiplierPenalty as MultiplierPenalty,
)
from solvers.soc.r_step import (
    CvxpyStep as CvxpyStep,
    RStep as RStep,
)
from solvers.soc.settings import Coupling as Coupling
from solvers.soc.soc import SOC as SOC
from solvers.solution import Solution as Solution
from solvers.solves.folder_solve import (
    solve_folder as solve_folder,
)
from solvers.solves.given_poses import certify as certify
from solvers.studies.benchmark import (
    BenchmarkMethod as BenchmarkMethod,
    BenchmarkSettings as BenchmarkSettings,
)
from solvers.studies.comparison import (
    ComparisonSettings as ComparisonSettings,
    compare_methods as compare_methods,
)
from solvers.studies.noise import (
    estimate_noise as estimate_noise,
)
from solvers.studies.paper_tables import (
    reproduce_tables as reproduce_tables,
)
from solvers.studies.readings import (
    compare_readings as compare_readings,
)
from solvers.studies.tightness import (
    SweptScene as SweptScene,
    noise_sweep as noise_sweep,
)
from solvers.team.robot import Robot as Robot
from solvers.team.sharing import Sharing as Sharing

__all__ = [
    "Measurement",
    "Solver",
    "Status",
    "iterate",
    "run",
]
__all__ += [
    "Pipeline",
    "Robot",
    "Robots",
    "Sharing",
    "Solution",
    "certify",
    "extend",
    "film",
    "solve",
    "solve_folder",
    "write_report",
]
__all__ += ["compare_readings"]
__all__ += ["estimate_noise"]
__all__ += ["SOC", "Coupling", "CvxpyStep", "PaperSOC", "RStep"]
__all__ += ["BalancedPenalty", "FixedPenalty", "MultiplierPenalty"]
__all__ += ["Newton", "Staircase", "gauss_newton", "polish"]
__all__ += ["GNC", "IRLS", "PCM", "Known", "RobustLoss", "prove_outliers"]
__all__ += ["GaussSeidel"]
__all__ += ["Checkpoint", "Faults", "InProcess", "RayEngine"]
__all__ += ["AlternatingBregman", "Bregman", "MethodOfMultipliers", "TwoLineBregman"]
__all__ += ["ExtendedSOC", "OrthogonalSOC", "solve_orthogonal"]
__all__ += [
    "compare_methods",
    "noise_sweep",
    "reproduce_tables",
]
# Types in the signatures of the names above.
__all__ += ["BenchmarkMethod", "BenchmarkSettings", "ComparisonSettings"]
__all__ += ["SweptScene"]
