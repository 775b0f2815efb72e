"""Starts in every component of O(d), which a run does not leave.

Two points of O(d) whose determinants differ are not connected, so that a run ends in the component
in which it begins. Starts take the patterns of signs of all determinants in a drawn order, each
once before any comes again. Where that is not all of them, one variable after the other of the best
point is reflected.
"""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from pgo_models.convex.constraint_sets import Orthonormal, Rotations
from pgo_models.convex.orthogonality import OrthogonalPoint, OrthogonalProblem
from pgo_models.geometry.rotations import Array

_MOST_LISTED = 10  # variables whose 2^k patterns are listed; of more they are drawn one by one


def with_free_determinants(problem: OrthogonalProblem) -> list[int]:
    """Positions of the variables that are in O(d), and in no other set."""
    positions = []
    for position, variable in enumerate(problem.variables):
        sets = problem.terms_of(position)
        is_in_O = isinstance(sets[0], Orthonormal) and not isinstance(sets[0], Rotations)
        is_square = variable.ndim == 2 and variable.shape[0] == variable.shape[1]
        if len(sets) == 1 and is_in_O and is_square:
            positions.append(position)
    return positions


def random_points(
    problem: OrthogonalProblem, rng: np.random.Generator
) -> Iterator[OrthogonalPoint]:
    """Random points without end, which take all patterns of signs in turn."""
    positions = with_free_determinants(problem)
    for signs in _patterns(len(positions), rng):
        values = list(problem.values(problem.random_point(rng).copies))
        for position, sign in zip(positions, signs, strict=True):
            if sign * np.linalg.det(values[position]) < 0.0:
                values[position] = _reflected(values[position])
        yield problem.point(values)


def reflections(problem: OrthogonalProblem, values: Sequence[Array]) -> Iterator[OrthogonalPoint]:
    """The points with one variable of O(d) reflected, one after the other."""
    for position in with_free_determinants(problem):
        changed = list(values)
        changed[position] = _reflected(values[position])
        yield problem.point(changed)


def _patterns(count: int, rng: np.random.Generator) -> Iterator[tuple[float, ...]]:
    if count > _MOST_LISTED:
        while True:
            yield tuple(rng.choice([-1.0, 1.0], count).tolist())
    all_patterns = list(itertools.product((1.0, -1.0), repeat=count))
    while True:
        for place in rng.permutation(len(all_patterns)) if count else [0]:
            yield all_patterns[place]


def _reflected(X: Array) -> Array:
    """X with its first column negated."""
    return X * np.where(np.arange(X.shape[1]) == 0, -1.0, 1.0)
