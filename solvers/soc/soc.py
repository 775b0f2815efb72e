"""SOC, splitting of orthogonality constraints: the settings, and the door to its couplings.

Each coupling is a class of its own, with `init`, `step`, `measure` and `converged`: `joint` is the
recursion to read first, `consensus` that of robots with copies of their neighbours' poses. JOINT by
robots and a driver, SUBSTRUCTURED, is `solvers.robots.soc`. Their states have x,
omega, B and rho in common.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from solvers.carry.registry import record
from solvers.result import Measurement, Status
from solvers.soc.joint import Joint, SOCState
from solvers.soc.settings import Coupling, SOCSettings

if TYPE_CHECKING:
    from solvers.soc.consensus import ConsensusState, LocalConsensus

    SOCIterate = SOCState | ConsensusState


@record("SOC")
@dataclass(frozen=True)
class SOC(SOCSettings):
    """Splitting of orthogonality constraints, after Ebrahimi & Deghat and Lai & Osher 2014.

    `PaperSOC` is Ebrahimi and Deghat's own Algorithm 1.

    Parameters
    ----------
    coupling : Coupling or None
        Who solves step (a). JOINT: one quadratic program over all poses. CONSENSUS: every robot
        solves a program over its own poses and copies of its neighbours', and the copies are made
        to agree by the recursion. SUBSTRUCTURED: the program of JOINT, solved by robots that
        eliminate their own poses and a driver that solves for the rest. Unless given, JOINT without
        `robots` and CONSENSUS with them. SUBSTRUCTURED has the iterates of JOINT: this class runs
        it as JOINT, and `solve(.., robots=..)` runs it on robots.
    robots : Partition or None
        Which robot owns which poses. `solve(.., robots=..)` and robots with files of their own know
        it without.
    penalty : PenaltyRule
        Rule of the ADMM penalty rho: MultiplierPenalty, FixedPenalty, BalancedPenalty, or an own
        one.
    alpha : float in (0, 2)
        Over-relaxation: alpha x + (1 - alpha) omega takes the place of x in (b) and (c). 1 is none.
    acceleration : Anderson or None
        Settings of the acceleration; None is the plain recursion.
    r_step : RStep or CustomRStep
        Back end of step (a).
    local_passes : int, at least 1
        Of CONSENSUS alone: how often a robot does (a) to (c) in a round; all but the last of them
        move only the poses that no other robot holds, and cost no message. 1 is the plain
        recursion.
    bytes_per_number : 1, 2 or 8
        Of CONSENSUS alone: of the rows that robots send each other. With 2, the default, a robot
        sends the change of its rows. Each number of the change is a whole multiple of 1/32767 of
        the largest one, and with 1 byte of 1/127 of it (`solvers.soc.rounding`). So are forces at
        the start. 8 is full precision, which robots that do not wait for each other always have.
    translation_penalty : float or None
        Of CONSENSUS alone: penalty of the translations of separators, the poses that several robots
        hold, as a multiple of their diagonal in M, the matrix of the cost F = tr(X^T M X). The
        default is 0.6 times the stiffness of the separators, the median over the robots. A robot's
        stiffness is the inverse of its mean compliance. The compliance of a separator is how far it
        moves under a unit force on its translation, in the scale of that diagonal, while rho holds
        the rotations, and without common shifts (`solvers.soc.separator_stiffness`). A given
        penalty stays. The default may fall when penalties are chosen anew: where the multipliers of
        these translations have changed little since the last choice, compared with the penalty
        times the distance that the translations have moved.
    tolerance : float
        Largest primal and dual residual, both relative, of a run that has converged.
    max_iterations : int
        Maximal number of iterations.

    Notes
    -----
    CONVERGED means, for JOINT and SUBSTRUCTURED, that x agrees with omega and that omega has
    stopped moving, each within the tolerance in the norm of rho; F and the poses are those of omega
    with the best translations for it. For CONSENSUS it means that x agrees with omega, and that the
    relative gradient of F over rotations and translations (`pgo_models.problem.stationarity`) is
    within the tolerance at the poses that the robots hold; F and the poses are those. Convergence
    does not bound the distance of F from a minimum, and the minimum need not be the global one.
    JOINT and SUBSTRUCTURED with a MultiplierPenalty end with NO_PROGRESS where 100 iterations have
    not brought the larger residual down by a tenth.

    Examples
    --------
    >>> import pgo_models as pgo
    >>> from solvers.loop import run
    >>> result = run(SOC(), pgo.PGOProblem(pgo.load("grid")))
    >>> result.status.name, round(result.objective, 2)
    ('CONVERGED', 97.01)

    Without acceleration and with one penalty for all poses, as in the paper:

    >>> from solvers import FixedPenalty
    >>> plain = SOC(penalty=FixedPenalty(30.0), acceleration=None)
    >>> run(plain, pgo.PGOProblem(pgo.load("grid"))).status.name
    'CONVERGED'
    """

    def init(self, problem: PGOProblem, start: Poses | None) -> "SOCIterate":
        """State 0: x = omega = `start`, the chordal relaxation unless given, and B = 0.

        In CONSENSUS with several robots B is not zero: it balances the different forces of the
        robots on the copies of a pose, and with a MultiplierPenalty its mean over the copies is
        that of a stationary point (`ConsensusRobot.start`).
        """
        problem.check_quadratic("SOC", convex=True)
        if self.coupling is Coupling.CONSENSUS and self.robots is None:
            raise SettingError("CONSENSUS needs robots; see pgo_models.partition()")
        poses = start if start is not None else chordal_start(problem)
        if self.is_split:
            return self._consensus.init(problem, poses)
        return Joint(self).init(problem, poses)

    def step(self, problem: PGOProblem, state: "SOCIterate") -> "SOCIterate":
        """Make one iteration: (a), (b), (c)."""
        if isinstance(state, SOCState):
            return Joint(self).step(problem, state)
        return self._consensus.step(problem, state)

    def measure(self, problem: PGOProblem, state: "SOCIterate") -> Measurement:
        """F of `poses`, and the residuals.

        The dual residual of CONSENSUS is the relative gradient of F at these poses.
        """
        if isinstance(state, SOCState):
            return Joint(self).measure(problem, state)
        return self._consensus.measure(problem, state)

    def poses(self, problem: PGOProblem, state: "SOCIterate") -> Poses:
        """Omega with the best translations for it; in CONSENSUS with those that the robots hold."""
        if isinstance(state, SOCState):
            return Joint(self).poses(problem, state)
        return self._consensus.poses(problem, state)

    def converged(self, state: "SOCIterate", measurement: Measurement) -> Status | None:
        """CONVERGED when both residuals are within tolerance; NO_PROGRESS of JOINT alone."""
        if isinstance(state, SOCState):
            return Joint(self).converged(state, measurement)
        return self._consensus.converged(state, measurement)

    @property
    def _consensus(self) -> "LocalConsensus":
        from solvers.soc.consensus import LocalConsensus  # with robots, copies and links

        return LocalConsensus(self)


# Relative residual from which Newton needs one or two factorisations, on all graphs tried.
WARM_START_TOLERANCE = 5e-3
WARM_START = SOC(tolerance=WARM_START_TOLERANCE, max_iterations=100)
