"""One robot of the substructured coupling: its part of the graph, and what orders have left there.

Orders are functions of an `Interior` and a request. They leave it as it is, and return the interior
after the order, and the answer. Requests and answers are arrays on the poses that the driver solves
for, sums, and the two numbers per pose from which the penalty's quantile is taken. Interior poses
leave the robot in snapshots and when the result is collected; edges between them never leave it.
`solvers.robots.driver` follows a whole solve, round by round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.dual_variables import multipliers_at
from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.problem import EvaluatedPoses, PGOProblem
from solvers.carry.registry import record
from solvers.robots.elimination import FactoredPart, RightHandSide, System
from solvers.robots.subdomain_blocks import Widths
from solvers.robust.losses import RobustLoss
from solvers.robust.weighted_edges import RatioSums
from solvers.soc.subgraph import Part, Subgraph


@record("CostParts")
@dataclass(frozen=True, eq=False)
class CostParts:
    """Part of F and of its rounding level, and the rows of M X on the boundary, ((d+1) g, d).

    In a robust solve, `ratios` are the sums that belong to the last `Reweigh`.
    """

    objective: float
    level: float
    force: Array
    ratios: RatioSums | None = None


@record("Reweigh")
@dataclass(frozen=True)
class Reweigh:
    """How edges are weighed by their residuals in a robust solve."""

    is_truncated: bool
    mu: float  # control of the robust loss's surrogate
    scale: float  # of the thresholds
    least: float  # weight under which an edge hardly counts
    left_out: float  # weight of such an edge, which keeps its place in the matrices

    @property
    def loss(self) -> RobustLoss:
        """The robust loss."""
        return RobustLoss.TRUNCATED if self.is_truncated else RobustLoss.GEMAN_MCCLURE


@record("Reweighed")
@dataclass(frozen=True, eq=False)
class Reweighed:
    """The cost with new weights, and the diagonal of its M on the boundary."""

    diagonal: Array
    at: CostParts


@record("ReducedTranslations")
@dataclass(frozen=True, eq=False)
class ReducedTranslations:
    """Right-hand side of the best translations, (g, d), and the first time their matrix."""

    b: Array
    schur: Array | None


@record("Session")
@dataclass(frozen=True, eq=False)
class Session:
    """What an algorithm leaves for its next order; each has what it needs beside it in a subclass.

    The session of an algorithm that tries poses has them as `trial`, which `accept` goes to.
    """

    system: System | None = None
    trial: Poses | None = None


@record("InteriorState")
@dataclass(frozen=True, eq=False)
class InteriorState:
    """What orders leave with a robot; the p poses are those of its part."""

    poses: Poses
    saved: Poses  # those that `restore_poses` returns to
    session: Session | None = None
    # whether the current cost is the one that is solved, not the one that SOC is run on
    is_final: bool = False
    weights: Array | None = None  # (k,): of its edges, in a robust solve
    reweighing: Reweigh | None = None  # how these weights came about
    has_sent_laplacian: bool = False  # whether the driver has the matrix of the translations
    terms: HandednessTerms | None = None  # of its edges, for proofs with them


S = TypeVar("S", bound=Session)


@dataclass(frozen=True, eq=False)
class Interior:
    """A robot's part of the graph with its factors, and the state that earlier orders left."""

    whole: Part  # the robot's edges, each with its full weight
    factored: FactoredPart  # with the weights of the state
    state: InteriorState
    evaluated: tuple[EvaluatedPoses, ...] = ()  # the poses of the state, and its trial

    # The part, and its cost.

    @property
    def part(self) -> Part:
        """The part, with the weights of the state."""
        return self.factored.part

    @property
    def problem(self) -> PGOProblem:
        """The current cost."""
        final = self.part.final
        if self.state.is_final and final is not None:
            return final
        return self.part.problem

    @property
    def tangent_problem(self) -> PGOProblem:
        """A quadratic cost that touches the current one at the current poses, or is it."""
        return self.at(self.poses).tangent

    @property
    def widths(self) -> Widths:
        """Widths of the rows of X: one of translations, and d of rotations."""
        return 1, self.part.problem.d

    @property
    def boundary_rows(self) -> IntArray:
        """Rows of X of the boundary."""
        return self.factored.cut(self.widths).boundary

    @property
    def interior_rows(self) -> IntArray:
        """Rows of X of the interior's rotations."""
        rows = self.factored.cut(self.widths).interior
        num_translations = len(self.part.interior)
        return rows[num_translations:]

    # The state.

    @property
    def poses(self) -> Poses:
        """The current poses."""
        return self.state.poses

    def session(self, kind: type[S]) -> S:
        """The session of the algorithm whose order this is."""
        session = self.state.session
        assert isinstance(session, kind)
        return session

    @property
    def system(self) -> System:
        """The system of the session, with the interior eliminated."""
        session = self.session(Session)
        assert session.system is not None
        return session.system

    @property
    def trial(self) -> Poses:
        """The poses that the session tries."""
        session = self.session(Session)
        assert session.trial is not None
        return session.trial

    def with_state(self, state: InteriorState) -> Interior:
        """The robot in another state, with the same weights."""
        following = replace(self, state=state)
        evaluated = [following.at(state.poses)]
        if state.session is not None and state.session.trial is not None:
            evaluated.append(following.at(state.session.trial))
        return replace(following, evaluated=tuple(evaluated))

    def at_poses(self, poses: Poses) -> Interior:
        """The robot at other poses."""
        return self.with_state(replace(self.state, poses=poses))

    def at_rotations(self, R: Array) -> Interior:
        """The robot at other rotations, and the same translations."""
        return self.at_poses(Poses(R, self.poses.t))

    def in_session(self, session: Session | None) -> Interior:
        """The robot with another session, or none."""
        return self.with_state(replace(self.state, session=session))

    def with_right(self, b: Array) -> tuple[Interior, RightHandSide]:
        """The robot whose session's system has the right-hand side b, and b reduced."""
        system, right = self.system.with_right(b)
        return self.in_session(replace(self.session(Session), system=system)), right

    def at_trial(self, trial: Poses) -> Interior:
        """The robot whose session tries these poses."""
        return self.in_session(replace(self.session(Session), trial=trial))

    def in_state_of(self, state: InteriorState) -> Interior:
        """The robot in a state of a snapshot, or with other weights, and the factors there."""
        part = self.whole if state.weights is None else self.whole.weighted(state.weights)
        # The patterns stay, and with them the analyses; the matrix of the translations does not.
        factored = replace(self.factored, part=part, known_laplacian=None)
        session = state.session
        if session is not None and session.system is not None:
            session = replace(session, system=factored.eliminated_again(session.system))
        return replace(self, factored=factored).with_state(replace(state, session=session))

    # The cost at poses.

    def at(self, poses: Poses) -> EvaluatedPoses:
        """The current cost at poses, computed once for those of the state and its trial."""
        for known in self.evaluated:
            if known.poses is poses and known.problem is self.problem:
                return known
        return self.problem.at(poses)

    def evaluation(self, poses: Poses) -> CostParts:
        """Evaluate the parts of F and of M X on the boundary, at poses, and sums of ratios."""
        here = self.at(poses)
        force = here.half_gradient[self.boundary_rows]
        reweighing = self.state.reweighing
        ratios = self.ratio_sums(poses, reweighing) if reweighing is not None else None
        return CostParts(here.value, rounding_level(self.problem, poses), force, ratios)

    # Its edges in a robust solve, each with its full weight.

    @property
    def thresholds(self) -> Array:
        """Thresholds of the robot's edges, (k,), infinite for known inliers."""
        assert self.whole.thresholds is not None
        return self.whole.thresholds

    @property
    def is_known(self) -> BoolArray:
        """Whether an edge is known to be right, (k,)."""
        return np.isinf(self.thresholds)

    def ratio_sums(self, poses: Poses, order: Reweigh) -> RatioSums:
        """Sums over the edges at poses."""
        costs = self.whole.costs(poses)
        thresholds = order.scale * self.thresholds
        return RatioSums.of_edges(costs, thresholds, self.is_known, order.loss, order.mu)

    def multipliers(self) -> Array:
        """Compute Lambda_i, which hold in the interior alone, where the robot has every edge."""
        return multipliers_at(self.at(self.poses))

    # Factors.

    def eliminate(self, K: csc_array, widths: Widths, b: Array) -> tuple[Interior, System]:
        """Eliminate the interior of K x = b."""
        factored, elimination = self.factored.eliminate(K, widths)
        return replace(self, factored=factored), System.of(K, widths, b, elimination)

    def with_laplacian(self) -> Interior:
        """The robot with the factor of the matrix of the translations."""
        return replace(self, factored=self.factored.with_laplacian())


def interior_of(subgraph: Subgraph, backend: CholeskyBackend | None) -> Interior | None:
    """Interior of a robot, its poses at the identity; None when it counts no edge."""
    part = subgraph.part
    if part is None:
        return None
    identity = Poses.identity(part.problem.num_poses, part.problem.d)
    state = InteriorState(poses=identity, saved=identity)
    return Interior(part, FactoredPart.of(part, backend), state)
