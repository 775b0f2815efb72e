"""Settings of SOC and its coupling, which the recursions of all couplings read.

They are a base class of `solvers.soc.soc.SOC`, because SOC calls the recursions and the recursions
read the settings.
"""

import enum
import math
from dataclasses import dataclass, field

from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition
from solvers.carry.registry import record
from solvers.result import Measurement, Status
from solvers.soc.anderson import Anderson
from solvers.soc.penalty import BoydPenalty, MultiplierPenalty, PenaltyOrder, PenaltyRule
from solvers.soc.r_step import BackEnd, RStep
from solvers.soc.recursion_block import StepSettings
from solvers.soc.rounding import WHOLE
from solvers.soc.safeguard import STALL_ITERATIONS, Steps

# Under a MultiplierPenalty rho_i of a separator's rotation is at least m_i times this times the
# square root of the translation penalty, or m_i times the maximum where that is less. On graphs
# with little noise the multipliers alone would hold the copies too loosely together.
_SEPARATOR_PENALTY = 0.7
_MAX_SEPARATOR_PENALTY = 0.3


@record("Coupling")
class Coupling(enum.Enum):
    """How the R-subproblem is shared."""

    JOINT = "one robot, all rotations and translations in one QP"
    CONSENSUS = "many robots, omega agreed between the copies of separator poses"
    SUBSTRUCTURED = (
        "many robots and a driver: the program of JOINT, split by elimination to the separators"
    )


@dataclass(frozen=True)
class SOCSettings:
    """Settings of `solvers.soc.soc.SOC`, whose docstring explains each of them."""

    coupling: Coupling | None = None
    robots: Partition | None = None
    penalty: PenaltyRule = field(default_factory=MultiplierPenalty)
    alpha: float = 1.0
    acceleration: Anderson | None = field(default_factory=Anderson)
    r_step: BackEnd = RStep.FACTORIZED
    local_passes: int = 10
    bytes_per_number: int = 2
    translation_penalty: float | None = None
    tolerance: float = 1e-5
    max_iterations: int = 500

    def __post_init__(self) -> None:
        if isinstance(self.penalty, BoydPenalty):
            raise SettingError(
                f"{self.penalty} has one rho for all poses; use it with PaperSOC, "
                "or a BalancedPenalty"
            )
        check_settings(self, relaxation=["alpha"], positive=["translation_penalty", "tolerance"])
        check_settings(
            self,
            not_negative=["max_iterations"],
            at_least_one=["local_passes"],
        )
        if self.bytes_per_number not in (1, 2, WHOLE):
            raise SettingError(f"bytes_per_number must be 1, 2 or 8, got {self.bytes_per_number}")
        if self.coupling is Coupling.JOINT and self._has_many_robots:
            raise SettingError(f"JOINT has one robot, got {self.robots}; use Coupling.CONSENSUS")

    @property
    def effective_coupling(self) -> Coupling:
        """The coupling that is used: `coupling`, or what follows from `robots`."""
        if self.coupling is not None:
            return self.coupling
        return Coupling.JOINT if self.robots is None else Coupling.CONSENSUS

    @property
    def is_split(self) -> bool:
        """Whether more than one robot holds copies."""
        return self.effective_coupling is Coupling.CONSENSUS and self._has_many_robots

    def status_at(self, measurement: Measurement) -> Status | None:
        """CONVERGED when both residuals are within tolerance."""
        worst = max(measurement.primal_residual, measurement.dual_residual)
        return Status.CONVERGED if worst <= self.tolerance else None

    def stall_of(self, steps: Steps) -> Status | None:
        """NO_PROGRESS where the residuals have not fallen for long, under a MultiplierPenalty.

        Another penalty may be far too small. The safeguard then doubles it many times, with
        iterations without progress between.
        """
        makes_no_progress = steps.k - steps.last_progress >= STALL_ITERATIONS
        has_stalled = isinstance(self.penalty, MultiplierPenalty) and makes_no_progress
        return Status.NO_PROGRESS if has_stalled else None

    # What the recursions are given.

    def penalty_order(self, ratio: Array, is_stationary: bool) -> PenaltyOrder:
        """Rule of rho, from ||Lambda_i||_2 / m_i of all poses, (n,)."""
        bounds = self.penalty.bounds(ratio)
        if not (len(bounds) == 3 and all(0 <= bound < math.inf for bound in bounds)):
            raise SettingError(
                f"{type(self.penalty).__name__}.bounds returned {bounds}; give three numbers that "
                "are not negative: (per_norm, per_scale, least)"
            )
        memory = 0 if self.acceleration is None else self.acceleration.memory
        of_steps = StepSettings(self.alpha, memory, self.local_passes, self.bytes_per_number)
        return PenaltyOrder(*bounds, is_stationary, of_steps)

    def separator_penalty_for(self, translation_penalty: float) -> float:
        """Least penalty of separator rotations over m_i, given that of their translations."""
        return min(_SEPARATOR_PENALTY * math.sqrt(translation_penalty), _MAX_SEPARATOR_PENALTY)

    @property
    def _has_many_robots(self) -> bool:
        return self.robots is not None and self.robots.num_robots > 1
