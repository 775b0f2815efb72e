"""GTSAM as a method to compare with: the same graph in its factors, its poses measured by our F.

With `Weighting.INFORMATION` its noise models are the information matrices: its cost is chi2, with
the logarithm in SE(d) for the residual. For F it minimises sum_e 1/2 ||Log(z_e^-1 x_i^-1 x_j)||^2
in units of standard deviations. A rotation residual of angle theta adds kappa ||R_j - R_i
R_ij||_F^2 = 4 kappa (1 - cos theta) = 2 kappa theta^2 + O(theta^4) to F, in the plane as in space,
so that

    sigma_R = 1 / (2 sqrt(kappa)),        sigma_t = 1 / sqrt(2 tau)

make its cost F to leading order. Its optimum is that of the angles, not of the chords, and lies
above ours in F by what is of fourth order. Nothing in these optimisers says how far from the
minimum they end; of rotations alone GTSAM has a certificate, `RiemannianStaircaseOptimizer` since
4.3: yes or no, with a tolerance. GTSAM is BSD-licensed: https://gtsam.org; the extra `peers` brings
it.
"""

import math
import time
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np

from pgo_models.errors import SettingError, extra_module
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, exp_map, project_to_rotations
from pgo_models.graphs.gtsam_graphs import poses_in_gtsam, to_gtsam
from pgo_models.graphs.pose_graph import isotropic_information
from pgo_models.graphs.precisions import proper_information
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.result import History, Measurement, Record, Run, Status


def run_gtsam(
    problem: PGOProblem,
    start: Poses | None = None,
    tolerance: float = 1e-5,
    max_iterations: int = 100,
) -> Run[Poses]:
    """Solve by GTSAM's Levenberg-Marquardt; history and objective are our F at its iterates.

    It ends where the relative change of its cost in one iteration is within the tolerance, whose
    default is GTSAM's.

    Without a start GTSAM has its own: chordal rotations and a Gauss-Newton step in space, LAGO in
    the plane. The seconds include making the factors and the start, and leave out importing GTSAM
    and measuring its poses.

    A MissingExtraError without GTSAM, a GraphError when the start does not fit the graph.
    """
    gtsam = extra_module("gtsam", "peers")
    if start is not None:
        start = problem.check_poses(start)
    began = time.perf_counter()
    graph = factor_graph(problem, start)
    if start is not None:
        values = gtsam.Values()
        for key, pose in enumerate(poses_in_gtsam(gtsam, start)):
            values.insert(key, pose)
    elif problem.d == 3:
        values = gtsam.InitializePose3.initialize(graph)
    else:
        values = gtsam.lago.initialize(graph, False)  # not every graph has an odometric path
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams())
    seconds = time.perf_counter() - began
    poses = poses_of_values(gtsam, optimizer.values(), problem.d)
    objective = problem.objective(poses)
    best = (objective, poses)
    records = [Record(0, seconds, Measurement(objective, 0.0, math.inf))]
    status = Status.MAX_ITERATIONS
    for k in range(1, max_iterations + 1):
        cost_before = optimizer.error()
        began = time.perf_counter()
        optimizer.iterate()
        seconds += time.perf_counter() - began
        cost = optimizer.error()
        if not math.isfinite(cost):
            records.append(Record(k, seconds, Measurement(math.nan, math.nan, math.nan)))
            status = Status.NOT_FINITE
            break
        change = abs(cost_before - cost) / max(cost_before, np.finfo(float).tiny)
        poses = poses_of_values(gtsam, optimizer.values(), problem.d)
        objective = problem.objective(poses)
        records.append(Record(k, seconds, Measurement(objective, 0.0, change)))
        best = min(best, (objective, poses), key=lambda pair: pair[0])
        if change <= tolerance or cost <= np.finfo(float).tiny:
            status = Status.CONVERGED
            best = (objective, poses)
            break
    objective, poses = best
    return Run(
        "GTSAM Levenberg-Marquardt",
        objective,
        poses,
        status,
        records[-1].k,
        History(tuple(records)),
        seconds,
        poses,
    )


def factor_graph(problem: PGOProblem, start: Poses | None = None) -> Any:  # noqa: ANN401 - GTSAM has no types
    """The `gtsam.NonlinearFactorGraph` of a problem, keys 0 .. n-1, with a prior on pose 0.

    The prior, at pose 0 of `start` or at the identity, fixes the gauge, which F leaves open. A
    MissingExtraError without GTSAM.
    """
    gtsam = extra_module("gtsam", "peers")
    graph = problem.graph
    d = problem.d
    if not problem.has_translations:
        raise SettingError("GTSAM is compared for poses, and the unknowns are rotations; solve()")
    if not ((graph.kappa > 0) & (graph.tau > 0)).all():
        raise SettingError(
            f"{graph.name} has edges without a rotation or position, "
            "which GTSAM is not given; solve()"
        )
    matrices = _information(problem)
    factors, _ = to_gtsam(replace(graph, ids=None, information=matrices, unheld=None, initial=None))
    pose_0 = Poses.identity(1, d) if start is None else start[:1]
    largest_information = np.einsum("mkk->mk", matrices).max(axis=0)
    in_order = np.roll(largest_information, 3) if d == 3 else largest_information
    noise = gtsam.noiseModel.Gaussian.Information(np.diag(in_order))
    prior = gtsam.PriorFactorPose3 if d == 3 else gtsam.PriorFactorPose2
    factors.add(prior(0, poses_in_gtsam(gtsam, pose_0)[0], noise))
    return factors


def _information(problem: PGOProblem) -> Array:
    """Information matrices of all edges for GTSAM, whose cost has the factor one half."""
    graph = problem.graph
    if problem.weighting is Weighting.INFORMATION:
        return 2.0 * proper_information(graph)
    # The information of an angle is twice kappa. `isotropic_information` has this factor in space,
    # and not in the plane.
    kappa = graph.kappa if problem.d == 3 else 2.0 * graph.kappa
    return 2.0 * isotropic_information(kappa, graph.tau, problem.d)


def poses_of_values(gtsam: ModuleType, values: Any, d: int) -> Poses:  # noqa: ANN401
    """Poses of values with keys 0 .. n-1, cleaned of rounding."""
    if d == 3:
        rows = np.asarray(gtsam.utilities.extractPose3(values))
        return Poses(project_to_rotations(rows[:, :9].reshape(-1, 3, 3)), rows[:, 9:])
    rows = np.asarray(gtsam.utilities.extractPose2(values))
    return Poses(exp_map(rows[:, 2:]), rows[:, :2])
