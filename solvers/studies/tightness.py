"""Where the semidefinite relaxation stops being tight: rotation noise swept on the paper's circle and grid."""

import enum
from dataclasses import dataclass

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.scenes import NETWORK_KAPPA, NETWORK_TAU, NoiseModel, circle, grid, observe
from solvers.studies.benchmark_runs import solve_whole


class SweptScene(enum.Enum):
    """Which network."""

    CIRCLE = "circle"
    GRID = "grid"


@dataclass(frozen=True, eq=False)
class NoiseSweep:
    """Which graphs were certified at which noise."""

    scene: SweptScene
    rotation_std: Array  # (levels,): radians
    # (levels, graphs): whether `solvers.solve` certified its answer. Where it did, the relaxation is tight; where it
    # did not, the relaxation is not tight, or the answer not optimal.
    certified: BoolArray
    gap: Array  # (levels, graphs): certified gap of the answer; the relaxation's own is at most that

    @property
    def fraction(self) -> Array:
        """Share of certified graphs at every level, (levels,)."""
        return np.asarray(self.certified.mean(axis=1))

    @property
    def last_tight(self) -> float:
        """Largest noise, radians, up to which every graph was certified; nan when there is none."""
        all_certified = np.logical_and.accumulate(self.certified.all(axis=1))
        return float(self.rotation_std[all_certified][-1]) if all_certified.any() else float("nan")

    def __str__(self) -> str:
        rows = [f"{'degrees':>8} {'certified':>10} {'worst gap':>10}"]
        for level, share, gaps in zip(self.rotation_std, self.fraction, self.gap, strict=True):
            rows.append(f"{np.rad2deg(level):>8.1f} {share:>10.0%} {gaps.max():>10.2g}")
        return "\n".join(rows)


def noisy_scene(scene: SweptScene, rotation_std: float, rng: np.random.Generator) -> PoseGraph:
    """The paper's network with its geometry, weights and translation noise, and another rotation noise, in radians."""
    network = circle(rng) if scene is SweptScene.CIRCLE else grid(rng)
    assert network.truth is not None
    noise = NoiseModel(rotation_std=rotation_std)
    return observe(scene.value, network.truth, network.i, network.j, noise, NETWORK_KAPPA, NETWORK_TAU, rng)


def noise_sweep(scene: SweptScene, rotation_std: Array, graphs: int, rng: np.random.Generator) -> NoiseSweep:
    """Solve and certify `graphs` random graphs at every noise level.

    `rotation_std`, (levels,), in radians; a SettingError unless positive and ascending, or when graphs is not positive.

    Examples
    --------
    >>> sweep = noise_sweep(SweptScene.GRID, np.array([0.1]), 2, np.random.default_rng(0))
    >>> sweep.fraction
    array([1.])
    """
    levels = np.asarray(rotation_std, dtype=float)
    if levels.ndim != 1 or not len(levels) or not (levels > 0).all() or (np.diff(levels) <= 0).any():
        raise SettingError(f"rotation_std must be positive and ascending, got {rotation_std}")
    if graphs < 1:
        raise SettingError(f"graphs must be at least 1, got {graphs}")
    certified = np.zeros((len(levels), graphs), dtype=bool)
    gap = np.zeros((len(levels), graphs))
    for level, std in enumerate(levels):
        for number in range(graphs):
            solution = solve_whole(noisy_scene(scene, float(std), rng))
            certified[level, number], gap[level, number] = solution.is_certified, solution.gap
    return NoiseSweep(scene, levels, certified, gap)
