"""Huber's loss by iteratively reweighted least squares (Holland & Welsch 1977).

    minimise  sum_e h(r_e^2),  h(s) = s up to c_e^2, 2 c_e s^1/2 - c_e^2 beyond

with r_e^2 the share of edge e in the cost. h is concave in s: the cost with weights h'(r_e^2) =
min(1, c_e / r_e) lies above it up to a constant and touches it, so that what lowers the weighted
cost lowers this one. Unlike truncated losses it has no minima but those that the rotations make,
and a wrong edge always keeps some weight.

No bound is given. On poses that cost at most H every r_e is at most (H + c_e^2) / (2 c_e), where a
quadratic touches h from below. Certificates with that quadratic proved the minimum to 1e-12 of five
public graphs without wrong edges (MIT, CSAIL, intel, kitti_07, parking-garage), and nothing where H
is above about ten c_e^2, as with one wrong edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pgo_models.errors import SettingError, check_quantile, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import chi2_thresholds
from pgo_models.summaries import Summarised
from solvers.result import Measurement, Status
from solvers.riemannian.newton import Newton
from solvers.soc.soc import SOC


def huber(squares: Array, thresholds: Array) -> Array:
    """Loss h of r^2, for thresholds c^2."""
    beyond = 2.0 * np.sqrt(squares * thresholds) - thresholds
    return np.where(squares <= thresholds, squares, beyond)


@dataclass(frozen=True, eq=False)
class IRLSState(Summarised):
    """State k.

    (m,) are the `costs` r_e^2 at the poses and the `thresholds` c_e^2. `objective` is Huber's cost,
    and `change` by how much the last step changed it, relative.
    """

    k: int
    poses: Poses
    costs: Array
    thresholds: Array
    objective: float
    change: float = math.inf


@dataclass(frozen=True)
class IRLS:
    """Settings of Huber's loss by reweighting.

    Parameters
    ----------
    quantile : float
        Probability with which a right edge costs no more than c_e^2 if its information matrix is
        right, in (0, 1).
    inner : Newton or SOC
        Method that lowers the weighted cost.
    inner_steps : int
        Steps of it for one set of weights, at most. SOC begins each time with B = 0, and needs as
        many as it takes to converge.
    tolerance : float
        Largest relative change of the cost in the last step.
    max_iterations : int
        Sets of weights, at most.

    References
    ----------
    Holland & Welsch, "Robust regression using iteratively reweighted least-squares", Communications
    in Statistics 1977.

    Examples
    --------
    >>> import solvers
    >>> from pgo_models import grid
    >>> solvers.run(IRLS(), grid(np.random.default_rng(0))).status.name
    'CONVERGED'
    """

    quantile: float = 0.99
    inner: Newton | SOC = field(default_factory=Newton)
    inner_steps: int = 1
    tolerance: float = 1e-10
    max_iterations: int = 500

    def __post_init__(self) -> None:
        if isinstance(self.inner, SOC) and self.inner.robots is not None:
            raise SettingError("weights are found in one place; leave out the robots of SOC")
        check_settings(
            self,
            positive=["tolerance"],
            at_least_one=["inner_steps"],
            not_negative=["max_iterations"],
        )
        check_quantile(self.quantile)

    def init(self, problem: PGOProblem, start: Poses | None) -> IRLSState:
        """State 0: `start`, or the chordal relaxation."""
        poses = start if start is not None else chordal_start(problem.convex_part)
        return self._at(problem, 0, poses, chi2_thresholds(problem, self.quantile))

    def step(self, problem: PGOProblem, state: IRLSState) -> IRLSState:
        """Weights for the current residuals, and steps towards the minimum with them."""
        weights = np.sqrt(state.thresholds / np.maximum(state.costs, state.thresholds))
        weighted = PGOProblem(problem.graph, problem.backend, problem.weights.scaled(weights))
        method: Any = self.inner  # either has states of its own
        inner = method.init(weighted, state.poses)
        for _ in range(self.inner_steps):
            inner = method.step(weighted, inner)
            measurement = method.measure(weighted, inner)
            if method.converged(inner, measurement) is not None:
                break
        poses = method.poses(weighted, inner)
        new = self._at(problem, state.k + 1, poses, state.thresholds)
        difference = abs(state.objective - new.objective)
        scale = max(new.objective, np.finfo(float).tiny)
        return replace(new, change=difference / scale)

    def measure(self, problem: PGOProblem, state: IRLSState) -> Measurement:
        """Huber's cost and its change."""
        return Measurement(state.objective, 0.0, state.change)

    def poses(self, problem: PGOProblem, state: IRLSState) -> Poses:
        """Return the poses of a state.

        Returns
        -------
        Poses
            Poses, world from body.
        """
        return state.poses

    def converged(self, state: IRLSState, measurement: Measurement) -> Status | None:
        """CONVERGED where the cost hardly changes."""
        return Status.CONVERGED if measurement.dual_residual <= self.tolerance else None

    def _at(self, problem: PGOProblem, k: int, poses: Poses, thresholds: Array) -> IRLSState:
        costs = problem.edge_costs(poses)
        objective = float(huber(costs, thresholds).sum())
        return IRLSState(k, poses, costs, thresholds, objective)
