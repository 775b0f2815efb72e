"""Noise at which the semidefinite relaxation is no longer tight, on the paper's circle and grid.

The rotation noise is swept from small to large. Graphs on which the relaxation is not tight are
solved again with handedness terms, which tell rotations from reflections.
"""

import enum
from dataclasses import dataclass

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.figures import rounded_up
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, as_generator, random_rotations
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.scenes import NETWORK_KAPPA, NETWORK_TAU, NoiseModel, circle, grid, observe
from pgo_models.summaries import Summarised
from solvers.request import Pipeline
from solvers.studies.benchmark_runs import solve_whole


class SweptScene(enum.Enum):
    """Network of the paper whose noise is swept."""

    CIRCLE = "circle"
    GRID = "grid"


@dataclass(frozen=True, eq=False)
class NoiseSweep(Summarised):
    """Result of a sweep: which graphs were certified at which noise."""

    scene: SweptScene  # the network
    rotation_std: Array  # (levels,): standard deviation of the rotation noise, radians
    # (levels, graphs): whether `solvers.solve` without handedness terms certified its solution. If
    # it did, the relaxation is tight; if not, the relaxation is not tight or the solution not
    # optimal.
    certified: BoolArray
    gap: Array  # (levels, graphs): gap of that solution; that of the relaxation is at most as large
    # (levels, graphs): whether `solvers.solve` certified its solution, with handedness terms at its
    # poses where it needs them.
    certified_with_terms: BoolArray

    @property
    def fraction(self) -> Array:
        """Fraction of graphs that the relaxation certifies at every level, (levels,)."""
        return np.asarray(self.certified.mean(axis=1))

    @property
    def fraction_with_terms(self) -> Array:
        """Fraction of graphs that are certified with terms at every level, (levels,)."""
        return np.asarray(self.certified_with_terms.mean(axis=1))

    @property
    def last_tight(self) -> float:
        """Largest noise, radians, up to which the relaxation certified every graph, or nan."""
        is_tight = np.logical_and.accumulate(self.certified.all(axis=1))
        if not is_tight.any():
            return float("nan")
        return float(self.rotation_std[is_tight][-1])

    def __str__(self) -> str:
        rows = [f"{'degrees':>8} {'certified':>10} {'worst gap':>10} {'with terms':>11}"]
        levels = zip(
            self.rotation_std, self.fraction, self.gap, self.fraction_with_terms, strict=True
        )
        for std, fraction, gaps, with_terms in levels:
            worst = rounded_up(gaps.max(), 2)
            degrees = np.rad2deg(std)
            rows.append(f"{degrees:>8.1f} {fraction:>10.0%} {worst:>10} {with_terms:>11.0%}")
        return "\n".join(rows)


def noisy_scene(scene: SweptScene, rotation_std: float, rng: np.random.Generator) -> PoseGraph:
    """The paper's network with another rotation noise, in radians.

    Geometry, weights and translation noise are those of the paper.
    """
    network = circle(rng) if scene is SweptScene.CIRCLE else grid(rng)
    noise = NoiseModel(rotation_std=rotation_std)
    return observe(
        scene.value, network.truth, network.i, network.j, noise, NETWORK_KAPPA, NETWORK_TAU, rng
    )


def noisy_lattice(
    side: int, rotation_std: float, rng: np.random.Generator, d: int = 3, kappa: float = 10.0
) -> PoseGraph:
    """side^d poses at a distance of 1 m with an edge between neighbours, and rotation noise.

    Truth rotations are uniform on SO(d), the rotation noise is in radians, that of translations
    0.1 m. The weights are kappa and tau = 100 on every edge.
    """
    n = side**d
    index = np.arange(n).reshape((side,) * d)
    position = np.stack(np.unravel_index(np.arange(n), index.shape), axis=1).astype(float)
    truth = Poses(random_rotations(n, d, rng), position)
    first = [np.take(index, range(side - 1), axis=axis).ravel() for axis in range(d)]
    second = [np.take(index, range(1, side), axis=axis).ravel() for axis in range(d)]
    noise = NoiseModel(translation_std=0.1, rotation_std=rotation_std)
    i = np.concatenate(first)
    j = np.concatenate(second)
    return observe("lattice", truth, i, j, noise, kappa, 100.0, rng)


def noise_sweep(
    scene: SweptScene, rotation_std: Array, graphs: int, rng: np.random.Generator | int
) -> NoiseSweep:
    """Solve and certify random graphs at every level of the rotation noise.

    Parameters
    ----------
    scene : SweptScene
        The network.
    rotation_std : ndarray, (levels,)
        Standard deviations of the rotation noise, radians, positive and ascending.
    graphs : int
        Number of graphs at every level.
    rng : numpy.random.Generator or int
        Source of the noise.

    Examples
    --------
    >>> sweep = noise_sweep(SweptScene.GRID, np.array([0.1]), 2, np.random.default_rng(0))
    >>> sweep.fraction
    array([1.])
    """
    rng = as_generator(rng)
    levels = np.asarray(rotation_std, dtype=float)
    is_list = levels.ndim == 1 and len(levels) > 0
    if not is_list or not (levels > 0).all() or (np.diff(levels) <= 0).any():
        raise SettingError(f"rotation_std must be positive and ascending, got {rotation_std}")
    if graphs < 1:
        raise SettingError(f"graphs must be at least 1, got {graphs}")
    certified = np.zeros((len(levels), graphs), dtype=bool)
    certified_with_terms = np.zeros_like(certified)
    gap = np.zeros((len(levels), graphs))
    relaxation_alone = Pipeline(handedness=None)
    for level, std in enumerate(levels):
        for number in range(graphs):
            graph = noisy_scene(scene, float(std), rng)
            solution = solve_whole(graph, relaxation_alone)
            certified[level, number] = solution.is_certified
            gap[level, number] = solution.certificate.printed_gap
            if not solution.is_certified:
                solution = solve_whole(graph)
            certified_with_terms[level, number] = solution.is_certified
    return NoiseSweep(scene, levels, certified, gap, certified_with_terms)
