"""Choice between the attempts of a robust solve: the least truncated cost decides."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import BoolArray
from solvers.robust.rejection import Attempt
from solvers.robust.revision import threshold_scale
from solvers.robust_solves.attempts import DoubtedProblem, Estimate

# Attempts at most, where they are cheap or most closures were rejected, and no two agree.
_SEVERAL_ATTEMPTS = 4
_SEVERAL_IF_LARGE = 2
# Share of the closures kept on which two attempts that agree may differ.
_AGREEING_SHARE = 0.01


@dataclass(frozen=True, eq=False)
class Choice:
    """The attempts made so far, compared by the truncated cost of all edges.

    The cost of poses X is

        TLS(X) = sum over known inliers of r_e^2 + sum over the other edges of min(r_e^2, s c_e^2)

    with c_e^2 the quantile of what a right edge costs and s, at most 1, ten times the least
    `error_scale` of all attempts. s is below 1 where errors are far smaller than the matrices
    claim: with s = 1 a map that deforms to fit wrong edges would then be the cheapest.
    """

    doubted: DoubtedProblem
    estimates: tuple[Estimate, ...]

    @property
    def threshold_scale(self) -> float:
        """Scale s of the thresholds."""
        least = min((estimate.error_scale for estimate in self.estimates), default=1.0)
        return threshold_scale(least)

    def cost(self, poses: Poses) -> float:
        """Truncated cost TLS of poses."""
        return self.doubted.truncated_cost(poses, self.threshold_scale)

    @property
    def by_cost(self) -> list[Estimate]:
        """The attempts, the cheapest first."""
        return sorted(self.estimates, key=lambda estimate: self.cost(estimate.poses))

    @property
    def cheapest(self) -> Estimate:
        """The attempt of the least truncated cost."""
        return self.by_cost[0]

    @property
    def is_enough(self) -> bool:
        """Whether no further attempt is needed.

        The cheapest attempt has to be certified, and the edges that it keeps may not form a tree. A
        certificate that needs complex numbers does not do: that the usual relaxation is loose is a
        sign of edges that contradict each other.
        Where attempts are cheap, or it rejects more than half of the closures, another one has to
        agree with it, or four have to be made, two on a large graph, where others take minutes.
        """
        cheapest = self.cheapest
        is_tree = int(cheapest.kept.sum()) < self.doubted.problem.num_poses
        certificate = cheapest.certificate
        if is_tree or not certificate.is_certified or certificate.bound.is_complex:
            return False
        keeps_most = 2 * self._num_closures_kept(cheapest) >= self.doubted.num_closures
        if keeps_most and not self.doubted.is_cheap and not self.doubted.is_large:
            return True
        several = _SEVERAL_IF_LARGE if self.doubted.is_large else _SEVERAL_ATTEMPTS
        return self._is_agreed(cheapest) or len(self.estimates) >= several

    def _is_agreed(self, estimate: Estimate) -> bool:
        """Whether another attempt keeps nearly the same edges."""
        num_tolerated = _AGREEING_SHARE * self._num_closures_kept(estimate)
        others = [other for other in self.estimates if other is not estimate]
        return any((other.kept != estimate.kept).sum() <= num_tolerated for other in others)

    def evidence(self, estimate: Estimate, odometry: BoolArray) -> float:
        """Logarithm, up to a constant, of the probability of all measurements under an estimate.

        It is -TLS / 2, and the logarithm of the probability that of m edges of a kind just these k
        are wrong, where each is with the probability k / m. The kinds are `odometry`, (m,), and
        others: odometry that is hardly ever wrong is dear to reject, and edges between consecutive
        scans that are wrong as often as others are not.
        """
        rejected = (~estimate.kept[odometry], ~estimate.kept[~odometry])
        return sum(map(_log_chance, rejected)) - 0.5 * self.cost(estimate.poses)

    def attempts_beside(self, kept: BoolArray) -> tuple[Attempt, ...]:
        """Records of the attempts, each with the number of its edges that the answer rejects."""
        return tuple(
            replace(
                estimate.attempt,
                cost=self.cost(estimate.poses),
                others=int((estimate.kept & ~kept).sum()),
            )
            for estimate in self.estimates
        )

    def _num_closures_kept(self, estimate: Estimate) -> int:
        return int((estimate.kept & ~self.doubted.known).sum())


def _log_chance(is_wrong: BoolArray) -> float:
    """Logarithm of the probability of just these wrong edges, (k,), at their own rate."""
    rate = float(is_wrong.mean()) if len(is_wrong) else 0.0
    if rate in (0.0, 1.0):
        return 0.0
    return len(is_wrong) * (rate * math.log(rate) + (1.0 - rate) * math.log(1.0 - rate))
