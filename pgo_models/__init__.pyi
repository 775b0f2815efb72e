from pgo_models.certificates.certificate import Certificate, Verdict, certify, certify_at
from pgo_models.certificates.dual_variables import certificate_matrix, multipliers
from pgo_models.certificates.lower_bound import prove_bound
from pgo_models.certificates.newton_polish import polish
from pgo_models.convex.bregman import BregmanProblem
from pgo_models.convex.convex_solver import ConvexSolver
from pgo_models.convex.graph_subproblem import ModelChange, graph_qp
from pgo_models.convex.orthogonality import OrthogonalProblem
from pgo_models.convex.rotation_subproblem import rotation_qp
from pgo_models.errors import PGOError
from pgo_models.geometry.poses import Poses, absolute_trajectory_error, relative_pose_error
from pgo_models.geometry.rotations import exp_map, log_map, project_to_rotations, random_rotations
from pgo_models.graphs.datasets import known_datasets, load
from pgo_models.graphs.g2o import read_g2o, write_g2o
from pgo_models.graphs.grid_worlds import grid_world
from pgo_models.graphs.partitioning import Partition, PartitionMethod, partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import RotationWeight
from pgo_models.graphs.residuals import Chi2Convention, chi2
from pgo_models.graphs.scenes import circle, grid, random_geometric, sphere, victoria_park
from pgo_models.graphs.trajectories import read_tum, write_tum
from pgo_models.plots.graph_plots import compare_poses, plot_graph
from pgo_models.plots.interactive_plots import explore_graph
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.initialization import chordal_start, odometry_start, spanning_tree_start
from pgo_models.problem.marginals import Marginals
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import chi2_thresholds, edge_residuals
from pgo_models.problem.weighting import Weighting
from pgo_models.relaxations.solve_sdp import solve_relaxation

__all__ = ["PGOError"]
__all__ += ["Poses", "absolute_trajectory_error", "relative_pose_error"]
__all__ += ["exp_map", "log_map", "project_to_rotations", "random_rotations"]
__all__ += ["Chi2Convention", "PoseGraph", "RotationWeight", "chi2", "chi2_thresholds", "edge_residuals"]
__all__ += ["Partition", "PartitionMethod", "partition"]
__all__ += ["known_datasets", "load", "read_g2o", "read_tum", "write_g2o", "write_tum"]
__all__ += ["circle", "grid", "grid_world", "random_geometric", "sphere", "victoria_park"]
__all__ += ["CholeskyBackend", "Marginals", "PGOProblem", "Weighting"]
__all__ += ["chordal_start", "odometry_start", "spanning_tree_start"]
__all__ += ["Certificate", "Verdict", "certificate_matrix", "certify", "certify_at"]
__all__ += ["multipliers", "polish", "prove_bound"]
__all__ += ["BregmanProblem", "ConvexSolver", "ModelChange", "OrthogonalProblem"]
__all__ += ["graph_qp", "rotation_qp", "solve_relaxation"]
__all__ += ["compare_poses", "explore_graph", "plot_graph"]
