"""Over-relaxation and safeguarded Anderson acceleration of a fixed-point map (Walker & Ni 2011; Zhang et al. 2020).

    s' = g(s) - sum_k gamma_k dg_k,   gamma = argmin || f - sum_k gamma_k df_k ||,   f = g(s) - s

over the last differences df_k of residuals and dg_k of images. The vectors may be spread over parties: each has its
rows (`AndersonShare`), and sums over the parties give everybody the coefficients (`AndersonSums`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pgo_models.errors import check_settings
from pgo_models.geometry.rotations import Array
from pgo_models.problem.matrices import inner

_SMALL = 3000  # numbers of a share up to which its differences are taken at once, from a copy


def over_relax(new: Array, old: Array, alpha: float) -> Array:
    """Alpha new + (1 - alpha) old (Boyd et al. 2011, section 3.4.3)."""
    return new if alpha == 1.0 else alpha * new + (1.0 - alpha) * old


@dataclass(frozen=True)
class Anderson:
    """Settings of the acceleration.

    `memory` past differences are combined, with a relative Tikhonov term, `regularization`; they are forgotten when the
    residual exceeds `restart_ratio` times the smallest since they last were. With `per_robot` every robot extrapolates
    its own rows with its own inner products, and nothing is summed over the robots; otherwise each round has one
    all-reduce, of the products of the newest difference with all others.
    """

    memory: int = 60
    regularization: float = 1e-12
    restart_ratio: float = 2.0
    per_robot: bool = False

    def __post_init__(self) -> None:
        check_settings(self, not_negative=["regularization"], at_least_one=["memory"], above_one=["restart_ratio"])


@dataclass(frozen=True, eq=False)
class AndersonShare:
    """One party's rows of what the acceleration remembers: past differences of residuals and of images."""

    residual_differences: tuple[Array, ...] = ()
    image_differences: tuple[Array, ...] = ()
    residual: Array | None = None
    image: Array | None = None

    def observe(self, residual: Array, image: Array, keep: int) -> tuple[Array, AndersonShare]:
        """Part of the sums, and the share with the newest of at most `keep` differences.

        `residual`, (rows, d), may carry weights; `image`, (rows, d), not. The sums, (1 + 2 q,), are ||residual||^2;
        newest . difference for the q differences, the newest last; difference . residual for them.
        """
        share = self.after(residual, image, keep)
        known = share.residual_differences
        if known and residual.size <= _SMALL:
            ends = np.array([known[-1], residual]).reshape(2, -1)
            sums = np.einsum("kr,er->ek", np.array(known).reshape(len(known), -1), ends).ravel()
        else:
            sums = np.array([inner(other, end) for end in (*known[-1:], residual) for other in known])
        return np.append(inner(residual, residual), sums), share

    def after(self, residual: Array, image: Array, keep: int) -> AndersonShare:
        """Return the share with the newest of at most `keep` differences."""
        if self.residual is None or self.image is None or not keep:
            return AndersonShare(residual=residual, image=image)
        residuals = (*(self.residual_differences[-(keep - 1) :] if keep > 1 else ()), residual - self.residual)
        images = (*(self.image_differences[-(keep - 1) :] if keep > 1 else ()), image - self.image)
        return AndersonShare(residuals, images, residual, image)

    def extrapolated(self, gamma: Array | None) -> tuple[Array, AndersonShare]:
        """Rows of image - sum_k gamma_k dg_k, and the share; None is a plain step after which it starts anew."""
        assert self.image is not None
        if gamma is None or not len(gamma):
            return self.image, self if gamma is not None else AndersonShare(residual=self.residual, image=self.image)
        known = self.image_differences[-len(gamma) :]
        if self.image.size <= _SMALL:
            return self.image - np.einsum("k,krd->rd", gamma, np.array(known)), self
        following = self.image.copy()
        for coefficient, difference in zip(gamma, known, strict=True):
            following -= coefficient * difference
        return following, self


@dataclass(frozen=True, eq=False)
class AndersonSums:
    """What all parties know: the Gram matrix of the differences, and the smallest residual since the last restart."""

    gram: Array = field(default_factory=lambda: np.zeros((0, 0)))
    smallest: float = np.inf

    def coefficients(self, settings: Anderson | None, sums: Array) -> tuple[Array | None, AndersonSums]:
        """Coefficients gamma of the differences, none without settings; None is a restart: parties forget theirs."""
        if settings is None:
            return np.zeros(0), self
        size = float(np.sqrt(sums[0]))
        if size > settings.restart_ratio * self.smallest:
            return None, AndersonSums(smallest=size)
        count, smallest = len(sums) // 2, min(self.smallest, size)
        if not count:
            return np.zeros(0), AndersonSums(smallest=smallest)
        gram = np.empty((count, count))
        gram[:-1, :-1] = self.gram[len(self.gram) - count + 1 :, len(self.gram) - count + 1 :]
        gram[-1, :] = gram[:, -1] = sums[1 : 1 + count]
        damped = gram + settings.regularization * np.trace(gram) * np.eye(count)
        gamma = np.linalg.lstsq(damped, sums[1 + count :], rcond=None)[0]
        return gamma, AndersonSums(gram, smallest)
