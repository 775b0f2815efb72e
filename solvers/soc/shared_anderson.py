"""Anderson acceleration of vectors that are spread over robots: every robot's share of the sums, and the coefficients.

The same numbers as `solvers.soc.anderson.extrapolate`: the inner products are summed over robots, one all-reduce of at
most 2 memory + 1 numbers, and the coefficients handed back.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pgo_models.geometry.rotations import Array
from pgo_models.problem.matrices import inner
from solvers.soc.anderson import Anderson


@dataclass(frozen=True, eq=False)
class AndersonShare:
    """A robot's rows of what the acceleration remembers; see `solvers.soc.anderson.AndersonMemory`."""

    residual_differences: tuple[Array, ...] = ()
    image_differences: tuple[Array, ...] = ()
    residual: Array | None = None
    image: Array | None = None

    def observe(self, residual: Array, image: Array, keep: int) -> tuple[Array, AndersonShare]:
        """Part of the sums, and the share with the newest differences.

        Returns
        -------
        sums : (1 + 2 q,)
            ||residual||^2; newest . difference for the q differences, the newest last; difference . residual for them.
        """
        size = inner(residual, residual)
        if self.residual is None or self.image is None:
            return np.array([size]), AndersonShare(residual=residual, image=image)
        newest = residual - self.residual
        residuals = (*(self.residual_differences[-(keep - 1) :] if keep > 1 else ()), newest)
        images = (*(self.image_differences[-(keep - 1) :] if keep > 1 else ()), image - self.image)
        sums = [size, *(inner(newest, other) for other in residuals), *(inner(other, residual) for other in residuals)]
        return np.array(sums), AndersonShare(residuals, images, residual, image)

    def combine(self, gamma: Array) -> Array:
        """Rows of image - sum_k gamma_k dg_k; no coefficient is a plain step."""
        assert self.image is not None
        following = self.image.copy()
        latest = self.image_differences[len(self.image_differences) - len(gamma) :]
        for coefficient, difference in zip(gamma, latest, strict=True):
            following -= coefficient * difference
        return following

    def restarted(self) -> AndersonShare:
        """Return the share with the differences forgotten."""
        return AndersonShare(residual=self.residual, image=self.image)


@dataclass(frozen=True, eq=False)
class AndersonSums:
    """The driver's part: the Gram matrix of the differences, and the smallest residual since the last restart."""

    gram: Array = field(default_factory=lambda: np.zeros((0, 0)))
    smallest: float = np.inf

    def coefficients(self, settings: Anderson, sums: Array) -> tuple[Array | None, AndersonSums]:
        """Coefficients gamma of the differences; None is a restart, after which robots forget theirs."""
        size = float(np.sqrt(sums[0]))
        if size > settings.restart_ratio * self.smallest:
            return None, AndersonSums(smallest=size)
        count = len(sums) // 2
        smallest = min(self.smallest, size)
        if not count:
            return np.zeros(0), AndersonSums(smallest=smallest)
        gram = np.empty((count, count))
        gram[:-1, :-1] = self.gram[len(self.gram) - count + 1 :, len(self.gram) - count + 1 :]
        gram[-1, :] = gram[:, -1] = sums[1 : 1 + count]
        damped = gram + settings.regularization * np.trace(gram) * np.eye(count)
        gamma = np.linalg.lstsq(damped, sums[1 + count :], rcond=None)[0]
        return gamma, AndersonSums(gram, smallest)
