from pgo_models.certificates.certificate import (
    Certificate as Certificate,
    Verdict as Verdict,
    certify_at as certify_at,
)
from pgo_models.certificates.dual_variables import (
    certificate_matrix as certificate_matrix,
    multipliers as multipliers,
)
from pgo_models.certificates.lower_bound import prove_bound as prove_bound
from pgo_models.certificates.proof_file import save_proof as save_proof
from pgo_models.convex.bregman import BregmanProblem as BregmanProblem
from pgo_models.convex.constraint_sets import ConstraintSet as ConstraintSet
from pgo_models.convex.convex_solver import ConvexSolver as ConvexSolver
from pgo_models.convex.graph_model import graph_model as graph_model
from pgo_models.convex.graph_subproblem import (
    GraphQP as GraphQP,
    ModelChange as ModelChange,
    graph_qp as graph_qp,
)
from pgo_models.convex.model_certificate import ModelCertificate as ModelCertificate
from pgo_models.convex.orthogonality import OrthogonalProblem as OrthogonalProblem
from pgo_models.convex.quadratic_form import (
    QuadraticForm as QuadraticForm,
    quadratic_form as quadratic_form,
)
from pgo_models.errors import PGOError as PGOError
from pgo_models.geometry.poses import (
    Poses as Poses,
    absolute_trajectory_error as absolute_trajectory_error,
    relative_pose_error as relative_pose_error,
)
from pgo_models.geometry.rotations import (
    exp_map as exp_map,
    log_map as log_map,
    project_to_rotations as project_to_rotations,
    random_rotations as random_rotations,
)
from pgo_models.graphs.datasets import (
    load as load,
)
from pgo_models.graphs.g2o import read_g2o as read_g2o, write_g2o as write_g2o
from pgo_models.graphs.g2o_readings import Reading as Reading
from pgo_models.graphs.grid_worlds import grid_world as grid_world
from pgo_models.graphs.gtsam_graphs import from_gtsam as from_gtsam, to_gtsam as to_gtsam
from pgo_models.graphs.partitioning import (
    PartitionMethod as PartitionMethod,
    partition as partition,
)
from pgo_models.graphs.pose_graph import PoseGraph as PoseGraph
from pgo_models.graphs.precisions import (
    without_indefinite_coupling as without_indefinite_coupling,
)
from pgo_models.graphs.residuals import Chi2Convention as Chi2Convention, chi2 as chi2
from pgo_models.graphs.scenes import (
    NoiseModel as NoiseModel,
    circle as circle,
    grid as grid,
    random_geometric as random_geometric,
    sphere as sphere,
    victoria_park as victoria_park,
)
from pgo_models.graphs.trajectories import (
    read_kitti as read_kitti,
    read_tum as read_tum,
    write_tum as write_tum,
)
from pgo_models.plots.films import animate as animate, animate_poses as animate_poses
from pgo_models.plots.graph_plots import compare_poses as compare_poses, plot_graph as plot_graph
from pgo_models.plots.interactive_plots import explore_graph as explore_graph
from pgo_models.problem.initialization import (
    chordal_start as chordal_start,
    odometry_start as odometry_start,
    spanning_tree_start as spanning_tree_start,
)
from pgo_models.problem.problem import PGOProblem as PGOProblem
from pgo_models.problem.thresholds import (
    chi2_thresholds as chi2_thresholds,
    edge_residuals as edge_residuals,
)
from pgo_models.problem.weighting import Weighting as Weighting
from pgo_models.relaxations.solve_sdp import (
    RelaxationForm as RelaxationForm,
    solve_relaxation as solve_relaxation,
)
from pgo_models.verification.verify import (
    verify_proof as verify_proof,
)

__all__ = ["PGOError"]
__all__ += ["Poses", "absolute_trajectory_error", "relative_pose_error"]
__all__ += ["exp_map", "log_map", "project_to_rotations", "random_rotations"]
__all__ += [
    "Chi2Convention",
    "PoseGraph",
    "chi2",
    "chi2_thresholds",
    "edge_residuals",
]
__all__ += ["without_indefinite_coupling"]
__all__ += ["PartitionMethod", "partition"]
__all__ += ["Reading", "load", "read_g2o", "write_g2o"]
__all__ += ["read_kitti", "read_tum", "write_tum"]
__all__ += ["from_gtsam", "to_gtsam"]
__all__ += ["circle", "grid", "grid_world", "random_geometric", "sphere", "victoria_park"]
__all__ += ["PGOProblem", "Weighting"]
__all__ += ["chordal_start", "odometry_start", "spanning_tree_start"]
__all__ += ["Certificate", "Verdict", "certificate_matrix", "certify_at"]
__all__ += ["multipliers", "prove_bound"]
__all__ += ["save_proof", "verify_proof"]
__all__ += ["BregmanProblem", "ConstraintSet", "ConvexSolver", "ModelChange"]
__all__ += ["ModelCertificate", "OrthogonalProblem", "QuadraticForm", "quadratic_form"]
__all__ += ["graph_model", "graph_qp", "solve_relaxation"]
__all__ += ["animate", "animate_poses", "compare_poses", "explore_graph", "plot_graph"]
# Types in the signatures of the names above.
__all__ += ["NoiseModel"]
__all__ += ["GraphQP"]
__all__ += ["RelaxationForm"]
