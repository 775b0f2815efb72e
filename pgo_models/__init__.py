"""Models of pose graph optimisation: graphs, the problem, its convex models, starts and certificates.

Nothing here iterates; methods are in `solvers`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from pgo_models.certificate import BoundSource, Certificate, Verdict, certify, certify_at
from pgo_models.cholesky import CholeskyBackend, default_backend
from pgo_models.chordal import CliqueTree, clique_tree
from pgo_models.curves import plot_decay, plot_tightness
from pgo_models.datasets import known_datasets, load
from pgo_models.errors import (
    DatasetError,
    EngineError,
    FileFormatError,
    GraphError,
    GraphWarning,
    MissingExtraError,
    NotPositiveDefiniteError,
    PGOError,
    ProofError,
    SettingError,
)
from pgo_models.figures import save_figure
from pgo_models.g2o import read_g2o, write_g2o
from pgo_models.grid_world import grid_world
from pgo_models.initialization import chordal_start, gps_imu_start, odometry_start, spanning_tree_start
from pgo_models.interactive import animate_poses, explore_graph, save_page
from pgo_models.lifted import LiftedPoint, hessian_product, lifted_point
from pgo_models.lower_bound import LowerBound, prove_bound
from pgo_models.matrices import connection_laplacian, joint_matrix, marginalized_matrix, residual_matrix
from pgo_models.matrix_plots import FactorPattern, factor_pattern, plot_sparsity, plot_spectrum, smallest_eigenvalues
from pgo_models.multipliers import certificate_matrix, multipliers
from pgo_models.partition import Partition, PartitionMethod, partition
from pgo_models.plots import compare_poses, draw_graph, plot_against_truth, plot_graph
from pgo_models.polish import polish
from pgo_models.pose_graph import PoseGraph
from pgo_models.poses import Poses, absolute_trajectory_error, relative_pose_error
from pgo_models.precisions import RotationWeight
from pgo_models.problem import PGOProblem
from pgo_models.published import PublishedFigures, PublishedRow, PublishedRun, published_rows, published_run
from pgo_models.relaxation_plan import RelaxationForm, RelaxationPlan, SDPSolver, plan_relaxation
from pgo_models.residuals import EdgeResiduals, edge_residuals, uncertain_edges
from pgo_models.rotations import exp_map, log_map, project_to_rotations, random_rotations
from pgo_models.rounding import RankReport, round_factor, round_gram
from pgo_models.scenes import NoiseModel, circle, grid, random_geometric, sphere
from pgo_models.separators import PartitionReport, report_partition, vertex_cover
from pgo_models.trajectories import read_kitti, read_tum, write_kitti, write_tum

if TYPE_CHECKING:
    from pgo_models.bregman_examples import (
        basis_pursuit,
        shared_rotation_step,
        total_variation_denoising,
        total_variation_scale_space,
    )
    from pgo_models.bregman_models import BregmanPoint, BregmanProblem
    from pgo_models.clique_sdp import CliqueRelaxation, clique_relaxation
    from pgo_models.graph_subproblem import Change, GraphQP, Neighbours, PoseVariables, Unknowns, graph_qp, robot_qp
    from pgo_models.orthogonal import KKTResiduals, OrthogonalPoint, OrthogonalProblem, kkt_residuals
    from pgo_models.orthogonal_examples import (
        one_norm_components,
        procrustes,
        rotation_averaging,
        smallest_eigenvectors,
        sparse_components,
        sparse_low_rank,
    )
    from pgo_models.relaxations import DualRelaxation, PrimalRelaxation, dual_relaxation, primal_relaxation
    from pgo_models.rotation_subproblem import RotationQP, rotation_qp
    from pgo_models.semidefinite import RelaxationSolution, RelaxationStatus, solve_relaxation

# cvxpy takes half of the time of an import: its models are loaded when one of their names is first used.
_CVXPY_MODELS = {
    "Change": "pgo_models.graph_subproblem",
    "GraphQP": "pgo_models.graph_subproblem",
    "Neighbours": "pgo_models.graph_subproblem",
    "PoseVariables": "pgo_models.graph_subproblem",
    "Unknowns": "pgo_models.graph_subproblem",
    "graph_qp": "pgo_models.graph_subproblem",
    "robot_qp": "pgo_models.graph_subproblem",
    "CliqueRelaxation": "pgo_models.clique_sdp",
    "clique_relaxation": "pgo_models.clique_sdp",
    "DualRelaxation": "pgo_models.relaxations",
    "PrimalRelaxation": "pgo_models.relaxations",
    "dual_relaxation": "pgo_models.relaxations",
    "primal_relaxation": "pgo_models.relaxations",
    "RelaxationSolution": "pgo_models.semidefinite",
    "RelaxationStatus": "pgo_models.semidefinite",
    "solve_relaxation": "pgo_models.semidefinite",
    "basis_pursuit": "pgo_models.bregman_examples",
    "shared_rotation_step": "pgo_models.bregman_examples",
    "total_variation_denoising": "pgo_models.bregman_examples",
    "total_variation_scale_space": "pgo_models.bregman_examples",
    "BregmanPoint": "pgo_models.bregman_models",
    "BregmanProblem": "pgo_models.bregman_models",
    "KKTResiduals": "pgo_models.orthogonal",
    "OrthogonalPoint": "pgo_models.orthogonal",
    "OrthogonalProblem": "pgo_models.orthogonal",
    "kkt_residuals": "pgo_models.orthogonal",
    "one_norm_components": "pgo_models.orthogonal_examples",
    "procrustes": "pgo_models.orthogonal_examples",
    "rotation_averaging": "pgo_models.orthogonal_examples",
    "smallest_eigenvectors": "pgo_models.orthogonal_examples",
    "sparse_components": "pgo_models.orthogonal_examples",
    "sparse_low_rank": "pgo_models.orthogonal_examples",
    "RotationQP": "pgo_models.rotation_subproblem",
    "rotation_qp": "pgo_models.rotation_subproblem",
}

__all__ = [
    "BoundSource",
    "BregmanPoint",
    "BregmanProblem",
    "Certificate",
    "Change",
    "CholeskyBackend",
    "CliqueRelaxation",
    "CliqueTree",
    "DatasetError",
    "DualRelaxation",
    "EdgeResiduals",
    "EngineError",
    "FactorPattern",
    "FileFormatError",
    "GraphError",
    "GraphQP",
    "GraphWarning",
    "KKTResiduals",
    "LiftedPoint",
    "LowerBound",
    "MissingExtraError",
    "Neighbours",
    "NoiseModel",
    "NotPositiveDefiniteError",
    "OrthogonalPoint",
    "OrthogonalProblem",
    "PGOError",
    "PGOProblem",
    "Partition",
    "PartitionMethod",
    "PartitionReport",
    "PoseGraph",
    "PoseVariables",
    "Poses",
    "PrimalRelaxation",
    "ProofError",
    "PublishedFigures",
    "PublishedRow",
    "PublishedRun",
    "RankReport",
    "RelaxationForm",
    "RelaxationPlan",
    "RelaxationSolution",
    "RelaxationStatus",
    "RotationQP",
    "RotationWeight",
    "SDPSolver",
    "SettingError",
    "Unknowns",
    "Verdict",
    "absolute_trajectory_error",
    "animate_poses",
    "basis_pursuit",
    "certificate_matrix",
    "certify",
    "certify_at",
    "chordal_start",
    "circle",
    "clique_relaxation",
    "clique_tree",
    "compare_poses",
    "connection_laplacian",
    "default_backend",
    "draw_graph",
    "dual_relaxation",
    "edge_residuals",
    "exp_map",
    "explore_graph",
    "factor_pattern",
    "gps_imu_start",
    "graph_qp",
    "grid",
    "grid_world",
    "hessian_product",
    "joint_matrix",
    "kkt_residuals",
    "known_datasets",
    "lifted_point",
    "load",
    "log_map",
    "marginalized_matrix",
    "multipliers",
    "odometry_start",
    "one_norm_components",
    "partition",
    "plan_relaxation",
    "plot_against_truth",
    "plot_decay",
    "plot_graph",
    "plot_sparsity",
    "plot_spectrum",
    "plot_tightness",
    "polish",
    "primal_relaxation",
    "procrustes",
    "project_to_rotations",
    "prove_bound",
    "published_rows",
    "published_run",
    "random_geometric",
    "random_rotations",
    "read_g2o",
    "read_kitti",
    "read_tum",
    "relative_pose_error",
    "report_partition",
    "residual_matrix",
    "robot_qp",
    "rotation_averaging",
    "rotation_qp",
    "round_factor",
    "round_gram",
    "save_figure",
    "save_page",
    "shared_rotation_step",
    "smallest_eigenvalues",
    "smallest_eigenvectors",
    "solve_relaxation",
    "spanning_tree_start",
    "sparse_components",
    "sparse_low_rank",
    "sphere",
    "total_variation_denoising",
    "total_variation_scale_space",
    "uncertain_edges",
    "vertex_cover",
    "write_g2o",
    "write_kitti",
    "write_tum",
]


def __getattr__(name: str) -> object:
    if name not in _CVXPY_MODELS:
        raise AttributeError(f"module 'pgo_models' has no attribute {name!r}")
    value: object = getattr(importlib.import_module(_CVXPY_MODELS[name]), name)
    return value
