"""The noise of odometry, closures and other kinds of edges, estimated from their residuals.

Variance components (Helmert 1907; Rao 1971; Patterson & Thompson 1971, restricted maximum
likelihood). All weights of a kind k of measurements are scaled by one number s_k. With A the
Gauss-Newton matrix of the cost over 2 at its minimum, A_k the part of kind k, N_k its number of
measurements and c_k its share of the cost, the scale is iterated by

    s_k <- s_k r_k / c_k,    r_k = N_k - tr(A^-1 A_k),

where r_k is what c_k is expected to be if the weights are right. The r_k sum up to the degrees of
freedom. A scale of which the loops say nothing, r_k near zero, is not known: then translations of
all kinds share one scale, and rotations another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array

from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, tangent_dimension
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import edge_precisions
from pgo_models.graphs.residuals import edge_errors
from pgo_models.problem.cholesky import lower_factor
from pgo_models.problem.hessian import riemannian_hessian, unknowns_of
from pgo_models.problem.matrices import entry_positions
from pgo_models.problem.problem import PGOProblem, as_problem
from pgo_models.problem.selected_inversion import selected_inverse
from pgo_models.problem.weighting import Weighting
from pgo_models.summaries import Summarised
from solvers.pipeline import solve
from solvers.request import Pipeline
from solvers.riemannian.polish import polish
from solvers.robust.known import odometry

_MOST_ROUNDS = 50  # of the fixed-point iteration; without convergence nothing is known
_SETTLED = 1e-4  # largest relative change of a scale in the last round
_LEAST_REDUNDANCY = 2.0  # r_k below which a scale is not known
_FARTHEST = 1e12  # factor on weights beyond which a kind of edges has no noise


@dataclass(frozen=True)
class NoiseLevel(Summarised):
    """Noise of one kind of edges: standard deviations of every component."""

    name: str  # "odometry", "closures", "landmarks", "priors", or "all edges"
    num_edges: int  # how many edges are of this kind
    # metres, in the median over the edges; nan if they measure no translation
    translation_std: float
    rotation_std: float  # radians, in the median over the edges; nan if they measure no rotation

    def __str__(self) -> str:
        parts = []
        if not np.isnan(self.translation_std):
            parts.append(f"{self.translation_std:.3g} m")
        if not np.isnan(self.rotation_std):
            parts.append(f"{np.rad2deg(self.rotation_std):.3g} degrees")
        return f"{self.name} {' and '.join(parts)}"


@dataclass(frozen=True, eq=False)
class NoiseEstimate(Summarised):
    """The noise of every kind of edges, and the graph with weights of this noise."""

    levels: tuple[NoiseLevel, ...]  # the kinds that the graph has
    graph: PoseGraph  # the same measurements with diagonal information matrices

    def __str__(self) -> str:
        return "; ".join(map(str, self.levels))


def estimate_noise(graph: PoseGraph | PGOProblem) -> NoiseEstimate:
    """Estimate the noise of odometry and closures from how well they fit each other.

    The weights of a kind of edges keep their ratios and get a common scale, one for translations
    and one for rotations, so that their costs are what is expected (module docstring). Odometry are
    the edges between poses of one robot with neighbouring ids. Wrong closures count as noise: find
    them first.

    The kappa and tau of the graph are where the iteration begins. A GraphError when the graph is
    not connected, or has no loops that tell of noise, or some edges fit exactly.

    References
    ----------
    Patterson & Thompson, "Recovery of inter-block information when block sizes are unequal",
    Biometrika 1971.

    Examples
    --------
    >>> import pgo_models as pgo
    >>> noise = pgo.NoiseModel(translation_std=0.1, rotation_std=0.02)
    >>> rng = np.random.default_rng(0)
    >>> graph = pgo.grid_world(1, 200, rng, noise=noise).unit_weights()
    >>> print(estimate_noise(graph).levels[0].name)
    odometry
    """
    if not isinstance(graph, PoseGraph):
        graph = as_problem(graph).graph
    graph.check_connected()
    kinds = _kinds(graph)
    for chosen in (kinds, {"all edges": np.ones(graph.num_edges, dtype=bool)}):
        components = _components(graph, chosen)
        estimate = _iterated(graph, components)
        if estimate is not None:
            kappa, tau = estimate
            levels = [_level(name, mask, graph, kappa, tau) for name, mask in chosen.items()]
            return NoiseEstimate(tuple(levels), _with_noise(graph, kappa, tau))
    raise GraphError(
        f"{graph.name} has too few loops to tell the noise of its edges, or edges without noise; "
        "give information matrices, or take the weights of the paper (--cost unit)"
    )


@dataclass(frozen=True, eq=False)
class _Component:
    """Weights that share a scale: those of translations or rotations of some edges, (m,)."""

    edges: BoolArray
    is_rotation: bool
    num_measured: int


def _kinds(graph: PoseGraph) -> dict[str, BoolArray]:
    """Edges of every kind that the graph has, (m,), by their names."""
    is_odometry = odometry(graph)
    to_landmark = np.isin(graph.j, graph.landmarks)
    kinds = {
        "odometry": is_odometry,
        "closures": ~is_odometry & ~to_landmark & ~graph.is_prior,
        "landmarks": to_landmark & ~graph.is_prior,
        "priors": graph.is_prior,
    }
    return {name: mask for name, mask in kinds.items() if mask.any()}


def _components(graph: PoseGraph, kinds: dict[str, BoolArray]) -> list[_Component]:
    """Components of all kinds. Landmarks have no rotations, whatever the weight of their first."""
    has_rotation = (graph.kappa > 0) & ~np.isin(graph.j, graph.landmarks)
    components = []
    for mask in kinds.values():
        of_translations = mask & (graph.tau > 0)
        of_rotations = mask & has_rotation
        if of_translations.any():
            num_measured = graph.d * int(of_translations.sum())
            components.append(_Component(of_translations, False, num_measured))
        if of_rotations.any():
            num_measured = tangent_dimension(graph.d) * int(of_rotations.sum())
            components.append(_Component(of_rotations, True, num_measured))
    return components


def _iterated(graph: PoseGraph, components: Sequence[_Component]) -> tuple[Array, Array] | None:
    """Kappa and tau with their scales settled; None where they cannot be known."""
    kappa = graph.kappa.copy()
    tau = graph.tau.copy()
    first = PGOProblem(graph.with_weights(kappa, tau), weighting=Weighting.ISOTROPIC)
    poses = solve(first, Pipeline(staircase=None, handedness=None)).poses
    for _ in range(_MOST_ROUNDS):
        problem = PGOProblem(graph.with_weights(kappa, tau), weighting=Weighting.ISOTROPIC)
        poses = polish(problem, poses)
        redundancy = _redundancies(problem, poses, components)
        costs = _costs(problem.graph, poses, components)
        if (redundancy < _LEAST_REDUNDANCY).any() or not (costs > redundancy / _FARTHEST).all():
            return None
        factors = redundancy / costs
        for component, factor in zip(components, factors, strict=True):
            weights = kappa if component.is_rotation else tau
            weights[component.edges] *= factor
        if np.abs(np.log(factors)).max() < _SETTLED:
            return kappa, tau
    return None


def _costs(graph: PoseGraph, poses: Poses, components: Sequence[_Component]) -> Array:
    """Shares of the cost, each about a sum of squares over variances."""
    translation, rotation, _ = edge_errors(graph, poses)
    of_translations = graph.tau * translation**2
    of_rotations = 2.0 * graph.kappa * rotation**2
    costs = []
    for component in components:
        of_edges = of_rotations if component.is_rotation else of_translations
        costs.append(of_edges[component.edges].sum())
    return np.array(costs)


def _redundancies(problem: PGOProblem, poses: Poses, components: Sequence[_Component]) -> Array:
    """N_k - tr(A^-1 A_k) of all components, by one selected inversion.

    The matrix is linear in the weights, so that A_k is what it gains when they are doubled.
    """
    graph = problem.graph
    A = _half_hessian(problem, poses)
    L, order = lower_factor(A, problem.backend)
    place = np.argsort(order)
    inverse = selected_inverse(L)
    redundancies = []
    for component in components:
        doubled = np.where(component.edges, 2.0, 1.0)
        kappa = graph.kappa * (doubled if component.is_rotation else 1.0)
        tau = graph.tau * (1.0 if component.is_rotation else doubled)
        heavier = PGOProblem(graph.with_weights(kappa, tau), weighting=Weighting.ISOTROPIC)
        gain = (_half_hessian(heavier, poses) - A).tocoo()
        rows, columns = place[gain.row], place[gain.col]
        positions = entry_positions(L, np.maximum(rows, columns), np.minimum(rows, columns))
        redundancies.append(component.num_measured - inverse[positions] @ gain.data)
    return np.array(redundancies)


def _half_hessian(problem: PGOProblem, poses: Poses) -> csc_array:
    """Half the Gauss-Newton matrix, (side, side), without the rows of pose 0."""
    hessian, layout = unknowns_of(problem, riemannian_hessian(problem.at(poses), None))
    free = np.arange(1, problem.num_poses)
    columns = np.concatenate([layout.translations(free), layout.rotations(free)], axis=1).ravel()
    return 0.5 * hessian[columns][:, columns].tocsc()


def _level(name: str, mask: BoolArray, graph: PoseGraph, kappa: Array, tau: Array) -> NoiseLevel:
    """Noise of the edges of a mask, (m,), in the median."""
    (rotations,) = np.nonzero(mask & (kappa > 0) & ~np.isin(graph.j, graph.landmarks))
    (translations,) = np.nonzero(mask & (tau > 0))
    translation_std = rotation_std = np.nan
    if len(translations):
        translation_std = float(np.median(tau[translations]) ** -0.5)
    if len(rotations):
        rotation_std = float(np.median(2.0 * kappa[rotations]) ** -0.5)
    return NoiseLevel(name, int(mask.sum()), translation_std, rotation_std)


def _with_noise(graph: PoseGraph, kappa: Array, tau: Array) -> PoseGraph:
    """The graph with the information matrices diag(tau, 2 kappa)."""
    d = graph.d
    p = tangent_dimension(d)
    diagonals = np.concatenate(
        [np.repeat(tau[:, None], d, axis=1), np.repeat(2.0 * kappa[:, None], p, axis=1)], axis=1
    )
    information = diagonals[:, :, None] * np.eye(d + p)
    kappa, tau = edge_precisions(information)
    return replace(
        graph,
        kappa=kappa,
        tau=tau,
        information=information,
        uncoupled=None,
        weights_error=0.0,
    )
