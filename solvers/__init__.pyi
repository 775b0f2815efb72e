from solvers.baselines.gauss_seidel import GaussSeidel as GaussSeidel
from solvers.baselines.levenberg_marquardt import LevenbergMarquardt as LevenbergMarquardt
from solvers.convex.bregman import (
    AlternatingBregman as AlternatingBregman,
    Bregman as Bregman,
    MethodOfMultipliers as MethodOfMultipliers,
    TwoLineBregman as TwoLineBregman,
)
from solvers.convex.extended_soc import ExtendedSOC as ExtendedSOC
from solvers.convex.orthogonal import (
    OrthogonalSOC as OrthogonalSOC,
    OrthogonalSolution as OrthogonalSolution,
    solve_orthogonal as solve_orthogonal,
)
from solvers.growing import extend as extend
from solvers.handedness.ascent import HandednessAscent as HandednessAscent
from solvers.handedness.complex_relaxation import ComplexRelaxation as ComplexRelaxation
from solvers.handedness.hull_lagrangian import HullLagrangian as HullLagrangian
from solvers.handedness.search import HandednessSearch as HandednessSearch
from solvers.loop import Method as Method, Solver as Solver, iterate as iterate, run as run
from solvers.network.engine import (
    Engine as Engine,
    InProcess as InProcess,
    WorkerPool as WorkerPool,
)
from solvers.network.faults import Faults as Faults
from solvers.network.ledger import Ledger as Ledger, Traffic as Traffic
from solvers.network.messages import Worker as Worker
from solvers.network.ray_engine import RayEngine as RayEngine
from solvers.network.recovery import Recovery as Recovery
from solvers.pipeline import solve as solve
from solvers.place import Automatic as Automatic
from solvers.reporting.edge_fit import EdgeFit as EdgeFit
from solvers.reporting.film import film as film
from solvers.reporting.report import write_report as write_report
from solvers.request import Pipeline as Pipeline
from solvers.result import (
    History as History,
    Measurement as Measurement,
    Outcome as Outcome,
    Record as Record,
    Run as Run,
    Stage as Stage,
    Status as Status,
)
from solvers.riemannian.newton import Newton as Newton, gauss_newton as gauss_newton
from solvers.riemannian.polish import polish as polish
from solvers.riemannian.prefixes import GrowingStart as GrowingStart
from solvers.riemannian.staircase import Staircase as Staircase
from solvers.robots import Checkpoint as Checkpoint, Robots as Robots
from solvers.robust.consistency import PCM as PCM, pairwise_consistent as pairwise_consistent
from solvers.robust.gnc import GNC as GNC
from solvers.robust.irls import IRLS as IRLS
from solvers.robust.known import Known as Known
from solvers.robust.losses import RobustLoss as RobustLoss
from solvers.robust.outlier_record import OutlierProof as OutlierProof
from solvers.robust.rejection import Rejection as Rejection, Support as Support
from solvers.robust_solves.outlier_proof import prove_outliers as prove_outliers
from solvers.soc.anderson import Anderson as Anderson
from solvers.soc.paper import PaperSOC as PaperSOC, PaperStop as PaperStop
from solvers.soc.penalty import (
    BalancedPenalty as BalancedPenalty,
    BoydPenalty as BoydPenalty,
    FixedPenalty as FixedPenalty,
    MultiplierPenalty as MultiplierPenalty,
    PenaltyRule as PenaltyRule,
)
from solvers.soc.r_step import (
    CustomRStep as CustomRStep,
    CvxpyStep as CvxpyStep,
    RotationStep as RotationStep,
    RStep as RStep,
    RSubproblem as RSubproblem,
)
from solvers.soc.settings import Coupling as Coupling
from solvers.soc.soc import SOC as SOC
from solvers.solution import Solution as Solution
from solvers.solves.folder_solve import (
    FolderSolution as FolderSolution,
    solve_folder as solve_folder,
)
from solvers.solves.given_poses import certify as certify
from solvers.studies.benchmark import (
    BenchmarkMethod as BenchmarkMethod,
    BenchmarkSettings as BenchmarkSettings,
)
from solvers.studies.comparison import (
    Comparison as Comparison,
    ComparisonSettings as ComparisonSettings,
    compare_methods as compare_methods,
)
from solvers.studies.noise import (
    NoiseEstimate as NoiseEstimate,
    NoiseLevel as NoiseLevel,
    estimate_noise as estimate_noise,
)
from solvers.studies.paper_tables import (
    Reproduction as Reproduction,
    ReproductionSettings as ReproductionSettings,
    reproduce_tables as reproduce_tables,
)
from solvers.studies.readings import (
    ReadingComparison as ReadingComparison,
    ReadingFit as ReadingFit,
    compare_readings as compare_readings,
)
from solvers.studies.tightness import (
    NoiseSweep as NoiseSweep,
    SweptScene as SweptScene,
    noise_sweep as noise_sweep,
)
from solvers.team.agent import Sharing as Sharing
from solvers.team.robot import Robot as Robot

__all__ = [
    "History",
    "Measurement",
    "Method",
    "Record",
    "Run",
    "Solver",
    "Stage",
    "Status",
    "iterate",
    "run",
]
__all__ += [
    "FolderSolution",
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
__all__ += ["ReadingComparison", "ReadingFit", "compare_readings"]
__all__ += ["NoiseEstimate", "NoiseLevel", "estimate_noise"]
__all__ += ["SOC", "Anderson", "Coupling", "CvxpyStep", "PaperSOC", "PaperStop", "RStep"]
__all__ += ["BalancedPenalty", "BoydPenalty", "FixedPenalty", "MultiplierPenalty", "PenaltyRule"]
__all__ += ["GrowingStart", "HandednessSearch", "Newton", "Staircase", "gauss_newton", "polish"]
__all__ += ["GNC", "IRLS", "PCM", "Known", "RobustLoss", "pairwise_consistent", "prove_outliers"]
__all__ += ["GaussSeidel", "LevenbergMarquardt"]
__all__ += ["Checkpoint", "Faults", "InProcess", "Ledger", "RayEngine"]
__all__ += ["AlternatingBregman", "Bregman", "MethodOfMultipliers", "TwoLineBregman"]
__all__ += ["ExtendedSOC", "OrthogonalSOC", "solve_orthogonal"]
__all__ += [
    "compare_methods",
    "noise_sweep",
    "reproduce_tables",
]
# Types in the signatures of the names above.
__all__ += ["Automatic", "ComplexRelaxation", "HandednessAscent", "HullLagrangian"]
__all__ += ["EdgeFit", "Outcome", "OutlierProof", "Rejection", "Support"]
__all__ += ["CustomRStep", "RSubproblem", "RotationStep"]
__all__ += ["OrthogonalSolution"]
__all__ += ["Engine", "Recovery", "Traffic", "Worker", "WorkerPool"]
__all__ += ["BenchmarkMethod", "BenchmarkSettings", "Comparison", "ComparisonSettings"]
__all__ += ["NoiseSweep", "SweptScene"]
__all__ += ["Reproduction", "ReproductionSettings"]
