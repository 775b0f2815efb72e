"""Over-relaxation and safeguarded Anderson acceleration of a fixed-point map (Walker & Ni 2011; Zhang et al. 2020)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.problem.matrices import inner, norm


def over_relax(new: Array, old: Array, alpha: float) -> Array:
    """Alpha new + (1 - alpha) old (Boyd et al. 2011, section 3.4.3)."""
    return new if alpha == 1.0 else alpha * new + (1.0 - alpha) * old


@dataclass(frozen=True)
class Anderson:
    """Settings of the acceleration.

    Attributes
    ----------
    memory : int
        How many past differences are combined.
    regularization : float
        Relative Tikhonov term of the least-squares problem.
    restart_ratio : float
        The memory is emptied when the residual exceeds this many times the smallest since it was last emptied.
    per_robot : bool
        Every robot extrapolates its own rows with its own inner products, and nothing is summed over the robots.
        Otherwise each round has one all-reduce, of the products of the newest difference with all others.

    Examples
    --------
    >>> Anderson(memory=5)
    Anderson(memory=5, regularization=1e-12, restart_ratio=2.0, per_robot=False)
    """

    memory: int = 60
    regularization: float = 1e-12
    restart_ratio: float = 2.0
    per_robot: bool = False

    def __post_init__(self) -> None:
        if self.memory < 1:
            raise SettingError(f"memory must be at least 1, got {self.memory}")
        if not self.regularization >= 0:
            raise SettingError(f"regularization must not be negative, got {self.regularization}")
        if not self.restart_ratio > 1:
            raise SettingError(f"restart_ratio must be above 1, got {self.restart_ratio}")


@dataclass(frozen=True, eq=False)
class AndersonMemory:
    """What the acceleration remembers: past differences of residuals and of images, and their Gram matrix."""

    residual_differences: tuple[Array, ...] = ()
    image_differences: tuple[Array, ...] = ()
    gram: Array = field(default_factory=lambda: np.zeros((0, 0)))
    residual: Array | None = None
    image: Array | None = None
    smallest: float = np.inf


def extrapolate(
    settings: Anderson, memory: AndersonMemory, residual: Array, image: Array
) -> tuple[Array, AndersonMemory]:
    """Next point s' from the image g(s) and the residual (g(s) - s), scaled to the norm that counts.

    s' = g(s) - sum_k gamma_k dg_k with gamma = argmin || residual - sum_k gamma_k df_k ||, over the last `memory`
    differences df_k of residuals and dg_k of images.

    Parameters
    ----------
    residual, image : (rows, d)
        `residual` may carry weights; `image` not.
    """
    size = norm(residual)
    if size > settings.restart_ratio * memory.smallest:
        memory = AndersonMemory()
    smallest = min(memory.smallest, size)
    if memory.residual is None or memory.image is None:
        return image, AndersonMemory(residual=residual, image=image, smallest=smallest)
    keep = settings.memory - 1
    older = memory.residual_differences[-keep:] if keep else ()
    older_images = memory.image_differences[-keep:] if keep else ()
    newest = residual - memory.residual
    gram = np.empty((len(older) + 1, len(older) + 1))
    gram[:-1, :-1] = memory.gram[len(memory.gram) - len(older) :, len(memory.gram) - len(older) :]
    gram[-1, :] = [inner(newest, other) for other in (*older, newest)]
    gram[:, -1] = gram[-1]
    residuals = (*older, newest)
    images = (*older_images, image - memory.image)
    right_hand_side = np.array([inner(other, residual) for other in residuals])
    damped = gram + settings.regularization * np.trace(gram) * np.eye(len(gram))
    gamma = np.linalg.lstsq(damped, right_hand_side, rcond=None)[0]
    following = image.copy()
    for coefficient, difference in zip(gamma, images, strict=True):
        following -= coefficient * difference
    return following, AndersonMemory(residuals, images, gram, residual, image, smallest)


def extrapolate_parts(
    settings: Anderson, memories: tuple[AndersonMemory, ...], residual: Array, image: Array, slices: tuple[slice, ...]
) -> tuple[Array, tuple[AndersonMemory, ...]]:
    """Extrapolate all rows together or, with `per_robot`, the rows of every robot on their own.

    Parameters
    ----------
    memories : tuple of AndersonMemory
        As returned by the step before; empty at first.
    slices : tuple of slice
        Rows of the robots.
    """
    parts = slices if settings.per_robot else (slice(None),)
    following, kept = np.empty_like(image), []
    for rows, memory in zip(parts, memories or (AndersonMemory(),) * len(parts), strict=True):
        following[rows], remembered = extrapolate(settings, memory, residual[rows], image[rows])
        kept.append(remembered)
    return following, tuple(kept)
