"""Models of pose graph optimisation: graphs, the problem, its convex models, starts and certificates.

Nothing here iterates; methods are in `solvers`.
"""

import importlib

# Public names, room by room, with the module that is imported when one of them is first used; types are in the stub.
_NAMES = {
    "pgo_models.errors": "PGOError",
    "pgo_models.geometry.poses": "Poses absolute_trajectory_error relative_pose_error",
    "pgo_models.geometry.rotations": "exp_map log_map project_to_rotations random_rotations",
    "pgo_models.graphs.residuals": "Chi2Convention chi2",
    "pgo_models.graphs.pose_graph": "PoseGraph",
    "pgo_models.graphs.precisions": "RotationWeight",
    "pgo_models.problem.thresholds": "chi2_thresholds edge_residuals",
    "pgo_models.graphs.partitioning": "Partition PartitionMethod partition",
    "pgo_models.graphs.datasets": "known_datasets load",
    "pgo_models.graphs.g2o": "read_g2o write_g2o",
    "pgo_models.graphs.trajectories": "read_tum write_tum",
    "pgo_models.graphs.scenes": "circle grid random_geometric sphere victoria_park",
    "pgo_models.graphs.grid_worlds": "grid_world",
    "pgo_models.problem.cholesky": "CholeskyBackend",
    "pgo_models.problem.marginals": "Marginals",
    "pgo_models.problem.problem": "PGOProblem",
    "pgo_models.problem.weighting": "Weighting",
    "pgo_models.problem.initialization": "chordal_start odometry_start spanning_tree_start",
    "pgo_models.certificates.certificate": "Certificate Verdict certify certify_at",
    "pgo_models.certificates.dual_variables": "certificate_matrix multipliers",
    "pgo_models.certificates.newton_polish": "polish",
    "pgo_models.certificates.lower_bound": "prove_bound",
    "pgo_models.convex.bregman": "BregmanProblem",
    "pgo_models.convex.convex_solver": "ConvexSolver",
    "pgo_models.convex.orthogonality": "OrthogonalProblem",
    "pgo_models.convex.graph_subproblem": "ModelChange graph_qp",
    "pgo_models.convex.rotation_subproblem": "rotation_qp",
    "pgo_models.relaxations.solve_sdp": "solve_relaxation",
    "pgo_models.plots.graph_plots": "compare_poses plot_graph",
    "pgo_models.plots.interactive_plots": "explore_graph",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = list(_MODULES)


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'pgo_models' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
