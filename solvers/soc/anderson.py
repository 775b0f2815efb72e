"""Over-relaxation and safeguarded Anderson acceleration of a fixed-point map s -> g(s).

    s' = g(s) - sum_k gamma_k dg_k,   gamma = argmin || f - sum_k gamma_k df_k ||,   f = g(s) - s

over the last differences df_k of residuals and dg_k of images: the type II of Fang & Saad 2009, as
in Walker & Ni 2011. The vectors may be spread over parties: each has its rows (`AndersonShare`),
and sums over the parties give all of them the same coefficients (`AndersonSums`). `extrapolate` is
the whole procedure where one party has all rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from pgo_models.errors import check_settings
from pgo_models.geometry.rotations import Array
from pgo_models.problem.matrices import inner
from solvers.carry.registry import record

# Shares of at most so many numbers take the products with all differences in one call of numpy,
# from a copy; above it the copy costs more than the calls.
_MAX_SIZE_OF_COPY = 3000
_REGULARIZATION = 1e-12  # relative Tikhonov term of the least-squares problem


def over_relax(new: Array, old: Array, alpha: float) -> Array:
    """Return alpha new + (1 - alpha) old (Boyd et al. 2011, section 3.4.3)."""
    return new if alpha == 1.0 else alpha * new + (1.0 - alpha) * old


@record("Anderson")
@dataclass(frozen=True)
class Anderson:
    """Settings of the Anderson acceleration.

    Parameters
    ----------
    memory : int, at least 1
        How many past differences are combined.
    restart_ratio : float above 1
        The differences are forgotten when the residual exceeds this many times the smallest one
        since they last were.

    References
    ----------
    Fang & Saad, Two classes of multisecant methods for nonlinear acceleration, 2009.
    Walker & Ni, Anderson acceleration for fixed-point iterations, 2011.
    Fu, Zhang & Boyd, Anderson accelerated Douglas-Rachford splitting, 2020, regularise type II as
    well.

    Examples
    --------
    >>> from solvers import SOC
    >>> SOC(acceleration=Anderson(memory=10)).acceleration.memory
    10
    """

    memory: int = 60
    restart_ratio: float = 2.0

    def __post_init__(self) -> None:
        check_settings(self, at_least_one=["memory"], above_one=["restart_ratio"])


@record("AndersonShare")
@dataclass(frozen=True, eq=False)
class AndersonShare:
    """One party's rows of the past differences of residuals and of images."""

    residual_differences: tuple[Array, ...] = ()
    image_differences: tuple[Array, ...] = ()
    residual: Array | None = None
    image: Array | None = None

    def observe(self, residual: Array, image: Array, keep: int) -> tuple[Array, AndersonShare]:
        """Part of the sums, and the share with the newest of at most `keep` differences.

        `residual`, (rows, d), may carry weights; `image`, (rows, d), does not. The sums, (1,) or (2
        + q,), are ||residual||^2, and if there are q > 0 differences ||newest||^2 and difference .
        residual for all of them, the newest last.
        """
        share = self.after(residual, image, keep)
        differences = share.residual_differences
        square = inner(residual, residual)
        if not differences:
            return np.array([square]), share
        if residual.size <= _MAX_SIZE_OF_COPY:
            flat_differences = np.array(differences).reshape(len(differences), -1)
            products = np.einsum("kr,r->k", flat_differences, residual.ravel())
        else:
            products = np.array([inner(difference, residual) for difference in differences])
        newest = differences[-1]
        return np.concatenate([[square, inner(newest, newest)], products]), share

    def after(self, residual: Array, image: Array, keep: int) -> AndersonShare:
        """Return the share with the newest of at most `keep` differences."""
        if self.residual is None or self.image is None or not keep:
            return AndersonShare(residual=residual, image=image)
        num_old = min(keep - 1, len(self.residual_differences))
        first = len(self.residual_differences) - num_old
        return AndersonShare(
            (*self.residual_differences[first:], residual - self.residual),
            (*self.image_differences[first:], image - self.image),
            residual,
            image,
        )

    def extrapolated(self, gamma: Array | None) -> tuple[Array, AndersonShare]:
        """Rows of image - sum_k gamma_k dg_k, and the share.

        Without coefficients the step is plain, and where `gamma` is None the share forgets its
        differences. All who have a row compute it in the same order, and so to the same bits.
        """
        assert self.image is not None
        if gamma is None:
            return self.image, AndersonShare(residual=self.residual, image=self.image)
        if not len(gamma):
            return self.image, self
        differences = self.image_differences[-len(gamma) :]
        if self.image.size <= _MAX_SIZE_OF_COPY:
            scaled = np.array(differences)
            scaled *= np.reshape(gamma, (-1,) + (1,) * self.image.ndim)
            return self.image - scaled.sum(axis=0), self
        total = gamma[0] * differences[0]
        for coefficient, difference in zip(gamma[1:], differences[1:], strict=True):
            total += coefficient * difference
        return self.image - total, self


@record("AndersonSums")
@dataclass(frozen=True, eq=False)
class AndersonSums:
    """What all parties know of the steps since the last restart."""

    gram: Array = field(default_factory=lambda: np.zeros((0, 0)))  # of the differences
    # Difference . residual for the differences, with the last residual.
    products: Array = field(default_factory=lambda: np.zeros(0))
    smallest: float = np.inf  # length of the smallest residual

    def coefficients(
        self, settings: Anderson | None, sums: Array
    ) -> tuple[Array | None, AndersonSums]:
        """Coefficients gamma of the differences, from the sums of `AndersonShare.observe`.

        There are none without settings; None is a restart, and the parties forget their
        differences.
        """
        if settings is None:
            return np.zeros(0), self
        length = float(np.sqrt(sums[0]))
        if length > settings.restart_ratio * self.smallest:
            return None, AndersonSums(smallest=length)
        smallest = min(self.smallest, length)
        if len(sums) == 1:
            return np.zeros(0), AndersonSums(smallest=smallest)
        products = sums[2:]
        num_differences = len(products)
        # The last rows and columns of the old matrix, without the difference that is dropped.
        first_kept = len(self.gram) - num_differences + 1
        gram = np.empty((num_differences, num_differences))
        gram[:-1, :-1] = self.gram[first_kept:, first_kept:]
        # newest = f - f_last, so that df_k . newest follows from df_k . f and df_k . f_last.
        gram[-1, :-1] = products[:-1] - self.products[first_kept:]
        gram[:-1, -1] = gram[-1, :-1]
        gram[-1, -1] = sums[1]
        damped = gram + _REGULARIZATION * np.trace(gram) * np.eye(num_differences)
        gamma = np.linalg.lstsq(damped, products, rcond=None)[0]
        return gamma, AndersonSums(gram, products, smallest)


def extrapolate(
    settings: Anderson | None,
    share: AndersonShare,
    sums: AndersonSums,
    residual: Array,
    image: Array,
) -> tuple[Array, float, AndersonShare, AndersonSums]:
    """Accelerate one step s -> g(s) of a party that has all rows.

    `residual` is g(s) - s, with weights; `image` is g(s). The result is the next s, the length of
    the residual, and what is remembered for the next step. Without settings the next s is the image
    itself, and where the residual is not finite it is nan.
    """
    new_sums, share = share.observe(residual, image, 0 if settings is None else settings.memory)
    merit = math.sqrt(new_sums[0])
    if not math.isfinite(merit):
        return np.full_like(image, np.nan), merit, share, sums
    gamma, sums = sums.coefficients(settings, new_sums)
    next_image, share = share.extrapolated(gamma)
    return next_image, merit, share, sums
