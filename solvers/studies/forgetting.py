"""Bregman iteration forgets the errors of its steps: a disturbed run beside an undisturbed one.

Yin & Osher, Error forgetting of Bregman iteration, 2013; the two-line form is equation (4) of
the paper.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.convex.bregman import BregmanProblem
from pgo_models.errors import SettingError, door
from pgo_models.geometry.arrays import check_shape
from pgo_models.geometry.rotations import Array, as_generator
from pgo_models.summaries import Summarised
from solvers.convex.bregman import TwoLineBregman


@dataclass(frozen=True, eq=False)
class ErrorForgetting(Summarised):
    """Distances ||x_k - x*|| of every iterate of three runs, from k = 0 on.

    Parameters
    ----------
    undisturbed : ndarray, (iterations + 1,)
        Bregman iteration.
    disturbed : ndarray, (iterations + 1,)
        Bregman iteration with an error added to x in the first steps.
    not_added_back : ndarray, (iterations + 1,)
        Quadratic penalties alone, with b held at 0: the error of that model does not vanish.
    disturbed_steps : int
        Number of the disturbed steps.
    """

    undisturbed: Array
    disturbed: Array
    not_added_back: Array
    disturbed_steps: int

    def curves(self) -> list[tuple[str, Array]]:
        """Return labelled curves for `pgo_models.plots.curves.plot_decay`.

        Returns
        -------
        list of (str, Array)
            Label and distances, (iterations + 1,), of every run.
        """
        return [
            ("Bregman iteration", self.undisturbed),
            (f"disturbed in its first {self.disturbed_steps} steps", self.disturbed),
            ("quadratic penalty alone (b = 0)", self.not_added_back),
        ]


@door
def error_forgetting(
    problem: BregmanProblem,
    solution: Array,
    rng: np.random.Generator | int,
    *,
    method: TwoLineBregman | None = None,
    error_std: float = 0.1,
    disturbed_steps: int = 3,
    iterations: int = 15,
) -> ErrorForgetting:
    """Compare a Bregman iteration with one whose first steps are disturbed.

    An error e ~ N(0, error_std^2 I) of step k gives x_k + e, as an inexact solver of the subproblem
    would, and b_k + K e, since the residual is added up.

    Parameters
    ----------
    problem : BregmanProblem
        The problem.
    solution : ndarray, (m,)
        Its solution x*, to which distances are measured.
    rng : numpy.random.Generator or int
        Source of the errors.
    method : TwoLineBregman, optional
        Settings, of which alpha and the tolerance of the subproblem are used; alpha = 5 unless
        given.
    error_std : float
        Standard deviation of the errors.
    disturbed_steps : int
        Number of steps that are disturbed.
    iterations : int
        Number of steps of every run.

    Returns
    -------
    ErrorForgetting
        Distances to the solution.

    Raises
    ------
    SettingError
        If `error_std` is negative, or there are more disturbed steps than iterations.

    Examples
    --------
    >>> from pgo_models.convex.bregman_examples import basis_pursuit
    >>> problem = basis_pursuit(np.array([[1.0, 2.0]]), np.array([2.0]))
    >>> rng = np.random.default_rng(0)
    >>> study = error_forgetting(problem, np.array([0.0, 1.0]), rng, iterations=6)
    >>> bool(study.disturbed[-1] < 1e-6 < study.disturbed[1])
    True
    """
    rng = as_generator(rng)
    check_shape(solution, (problem.K.shape[1],), "solution")
    if not error_std >= 0:
        raise SettingError(f"error_std must not be negative, got {error_std}")
    if not 0 <= disturbed_steps <= iterations:
        raise SettingError(
            f"disturbed_steps must be 0 to iterations, got {disturbed_steps} of {iterations}"
        )
    method = method if method is not None else TwoLineBregman(alpha=5.0)
    undisturbed = _iterates(problem, method, iterations)
    errors = [rng.normal(0.0, error_std, undisturbed[0].shape) for _ in range(disturbed_steps)]
    disturbed = _iterates(problem, method, iterations, errors)
    not_added_back = _iterates(problem, method, iterations, keeps_b=False)

    def distances(iterates: Sequence[Array]) -> Array:
        return np.array([np.linalg.norm(x - solution) for x in iterates])

    return ErrorForgetting(
        distances(undisturbed), distances(disturbed), distances(not_added_back), disturbed_steps
    )


def _iterates(
    problem: BregmanProblem,
    method: TwoLineBregman,
    iterations: int,
    errors: Sequence[Array] = (),
    keeps_b: bool = True,
) -> list[Array]:
    """Iterates x_k, with errors in the first steps; b is held at its start unless `keeps_b`."""
    start = method.init(problem, None)
    state = start
    iterates = [start.x]
    for k in range(iterations):
        state = method.step(problem, state)
        if k < len(errors):
            state = replace(state, x=state.x + errors[k], b=state.b + problem.K @ errors[k])
        if not keeps_b:
            state = replace(state, b=start.b)
        iterates.append(state.x)
    return iterates
