"""SOC that hands an iterate of a quadratic model over to Newton.

Newton moves it to the stationary point nearby. That is a fixed point of SOC with the multipliers
which it has there, so that SOC ends at it, within its tolerances. SOC alone takes hundreds of
iterations where J is flat.
"""

from dataclasses import dataclass, replace
from typing import Any

from pgo_models.convex.orthogonality import OrthogonalPoint, OrthogonalProblem
from pgo_models.convex.quadratic_split import QuadraticSplit
from solvers.convex.model_newton import ModelNewton
from solvers.loop import Method
from solvers.result import Measurement, Status

_HANDED_OVER = 6  # the iterate before which Newton takes its steps


@dataclass(frozen=True, eq=False)
class SOCWithNewton:
    """SOC, with Newton once on the way.

    Parameters
    ----------
    soc : Method
        SOC.
    split : QuadraticSplit
        Its step (a).
    newton : ModelNewton
        Newton for the same model.
    """

    soc: Method[OrthogonalProblem, OrthogonalPoint, Any]
    split: QuadraticSplit
    newton: ModelNewton

    @property
    def max_iterations(self) -> int:
        """That of SOC."""
        return self.soc.max_iterations

    def init(self, problem: OrthogonalProblem, start: OrthogonalPoint | None) -> Any:  # noqa: ANN401 - a state of SOC
        """State 0 of SOC."""
        return self.soc.init(problem, start)

    def step(self, problem: OrthogonalProblem, state: Any) -> Any:  # noqa: ANN401 - a state of SOC
        """Make one iteration of SOC, once from where Newton ends."""
        if state.k + 1 != _HANDED_OVER:
            return self.soc.step(problem, state)
        form = self.newton.form
        u = self.newton.polish(form.u_of(problem.values(state.copies)))
        point = self.split.stationary_point(u)
        # SOC chooses a penalty with which the point is a fixed point.
        again = replace(self.soc.init(problem, point), k=state.k, scale=state.scale)
        return self.soc.step(problem, again)

    def measure(self, problem: OrthogonalProblem, state: Any) -> Measurement:  # noqa: ANN401 - a state of SOC
        """Figures of a state of SOC."""
        return self.soc.measure(problem, state)

    def converged(self, state: Any, measurement: Measurement) -> Status | None:  # noqa: ANN401 - a state of SOC
        """CONVERGED when SOC says so."""
        return self.soc.converged(state, measurement)
