"""Settings of SOC, for all couplings."""

import enum
import math
from dataclasses import dataclass, field

from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition
from solvers.result import Measurement, Status
from solvers.soc.anderson import Anderson
from solvers.soc.penalty import BoydPenalty, MultiplierPenalty, PenaltyOrder, PenaltyRule
from solvers.soc.r_step import BackEnd, RStep
from solvers.soc.recursion_block import StepSettings

_SEPARATOR_PENALTY, _MOST_SEPARATOR_PENALTY = 0.7, 0.3  # times the root of the translation penalty, and no more


class Coupling(enum.Enum):
    """How the R-subproblem is shared."""

    JOINT = "one robot, all rotations and translations in one QP"
    CONSENSUS = "many robots, omega agreed between the copies of separator poses"
    SUBSTRUCTURED = "many robots and a driver: the program of JOINT, split by elimination to the separators"


@dataclass(frozen=True)
class SOCSettings:
    """Settings of `solvers.soc.soc.SOC`, which documents them, as its recursions need them."""

    coupling: Coupling | None = None
    robots: Partition | None = None
    penalty: PenaltyRule = field(default_factory=MultiplierPenalty)
    alpha: float = 1.0
    acceleration: Anderson | None = field(default_factory=Anderson)
    r_step: BackEnd = RStep.FACTORIZED
    local_passes: int = 10
    translation_penalty: float | None = None
    separator_penalty: float | None = None
    tolerance: float = 1e-5
    max_iterations: int = 500

    def __post_init__(self) -> None:
        if isinstance(self.penalty, BoydPenalty):
            raise SettingError(f"{self.penalty} has one rho for all poses; use it with PaperSOC, or a BalancedPenalty")
        check_settings(self, relaxation=["alpha"], positive=["translation_penalty", "tolerance"])
        check_settings(self, not_negative=["separator_penalty", "max_iterations"], at_least_one=["local_passes"])
        if self.coupling is Coupling.JOINT and self.robots is not None and self.robots.num_robots > 1:
            raise SettingError(f"JOINT has one robot, got {self.robots}; use Coupling.CONSENSUS")
        if self.coupling is Coupling.CONSENSUS and self.robots is None:
            raise SettingError("CONSENSUS needs robots; see pgo_models.partition()")

    @property
    def effective_coupling(self) -> Coupling:
        """The coupling that is used."""
        if self.coupling is not None:
            return self.coupling
        return Coupling.JOINT if self.robots is None else Coupling.CONSENSUS

    def converged(self, state: object, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals are within tolerance."""
        worst = max(measurement.primal_residual, measurement.dual_residual)
        return Status.CONVERGED if worst <= self.tolerance else None

    @property
    def is_split(self) -> bool:
        """Whether more than one robot holds copies."""
        return self.effective_coupling is Coupling.CONSENSUS and self.robots is not None and self.robots.num_robots > 1

    @property
    def step_settings(self) -> StepSettings:
        """What a robot must know of them."""
        found = self.acceleration
        alone = found if found is not None and found.per_robot else None
        return StepSettings(self.alpha, found.memory if found is not None else 0, self.local_passes, alone)

    def penalty_order(self, ratio: Array, is_stationary: bool) -> PenaltyOrder:
        """Rule of rho, from ||Lambda_i||_2 / m_i of all poses, (n,)."""
        return PenaltyOrder(*self.penalty.bounds(ratio), is_stationary, self.step_settings)

    def separator_penalty_for(self, translation_penalty: float) -> float:
        """Least penalty of separator rotations, times m_i, beside a penalty of their translations."""
        if self.separator_penalty is not None:
            return self.separator_penalty
        return min(_SEPARATOR_PENALTY * math.sqrt(translation_penalty), _MOST_SEPARATOR_PENALTY)
