"""Bregman iteration forgets the errors of its steps: a run disturbed on the way beside one that is not.

Yin & Osher, Error forgetting of Bregman iteration, 2013; the two-line form is the paper's `bregman update`.
"""

from dataclasses import dataclass, replace

import numpy as np

from pgo_models.convex.bregman import BregmanProblem
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from solvers.convex.bregman import TwoLineBregman


@dataclass(frozen=True, eq=False)
class ErrorForgetting:
    """||x_k - x*|| of every iterate, from k = 0 on, (iterations + 1,) each."""

    undisturbed: Array
    disturbed: Array  # with an error added to x in the first steps
    not_added_back: Array  # by plain quadratic penalties, b held at 0: the error of the model itself, which stays
    disturbed_steps: int

    def curves(self) -> list[tuple[str, Array]]:
        """Labelled curves for `pgo_models.plot_decay`."""
        disturbed = f"disturbed in its first {self.disturbed_steps} steps"
        names = "Bregman iteration", disturbed, "quadratic penalty alone (b = 0)"
        return list(zip(names, (self.undisturbed, self.disturbed, self.not_added_back), strict=True))


def error_forgetting(
    problem: BregmanProblem,
    solution: Array,
    rng: np.random.Generator,
    *,
    method: TwoLineBregman | None = None,
    error_std: float = 0.1,
    disturbed_steps: int = 3,
    iterations: int = 15,
) -> ErrorForgetting:
    """Run Bregman iteration with and without errors in its first steps.

    An error e ~ N(0, error_std^2 I) of step k gives x_k + e and, as the residual is added up, b_k + K e. `solution` is
    x*, (m,), to which distances are measured; of `method` alpha and its subproblem's tolerance are used. A SettingError
    when error_std is negative or there are fewer iterations than disturbed steps.

    Examples
    --------
    >>> from pgo_models.convex.bregman_examples import basis_pursuit
    >>> problem = basis_pursuit(np.array([[1.0, 2.0]]), np.array([2.0]))
    >>> study = error_forgetting(problem, np.array([0.0, 1.0]), np.random.default_rng(0), iterations=6)
    >>> bool(study.disturbed[-1] < 1e-6 < study.disturbed[1])
    True
    """
    if not error_std >= 0:
        raise SettingError(f"error_std must not be negative, got {error_std}")
    if not 0 <= disturbed_steps <= iterations:
        raise SettingError(f"disturbed_steps must be 0 to iterations, got {disturbed_steps} of {iterations}")
    method = method if method is not None else TwoLineBregman(alpha=5.0)
    start = method.init(problem, None)
    distances = []
    for error_steps, keeps_b in ((0, True), (disturbed_steps, True), (0, False)):
        state, iterates = start, [start.x]
        for k in range(iterations):
            state = method.step(problem, state)
            if k < error_steps:
                error = rng.normal(0.0, error_std, state.x.shape)
                state = replace(state, x=state.x + error, b=state.b + problem.K @ error)
            if not keeps_b:
                state = replace(state, b=start.b)
            iterates.append(state.x)
        distances.append(np.array([np.linalg.norm(x - solution) for x in iterates]))
    undisturbed, disturbed, not_added_back = distances
    return ErrorForgetting(undisturbed, disturbed, not_added_back, disturbed_steps)
