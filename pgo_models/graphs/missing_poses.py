"""Poses that a file has no estimate of, placed along its edges from those that it has one of."""

import warnings
from dataclasses import replace

import numpy as np

from pgo_models.errors import GraphWarning
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.pose_graph import PoseGraph

_LEAST_SHARE = 0.5  # of the poses with an estimate, for the others to be placed beside them


def with_missing_poses(
    graph: PoseGraph, estimate: Poses, is_known: BoolArray, place: str
) -> PoseGraph:
    """Return the graph with an estimate of all poses, or none, and warn of what is missing.

    `estimate` has all poses but the world's, and `is_known`, (k,), says which of them are known. At
    least half of them must be, and edges must lead from there to all others. `place` is the name of
    the file.
    """
    is_placed = is_known
    if is_known.mean() >= _LEAST_SHARE:
        estimate, is_placed = _placed_along_edges(graph, estimate, is_known)
    missing = graph.in_files[~is_known]
    outcome = "they are placed along edges" if is_placed.all() else "the estimate is left out"
    warnings.warn(
        f"{place}: {len(missing)} of {len(is_known)} poses have no VERTEX line (the first is "
        f"{graph.pose_name(int(missing[0]))}); {outcome}",
        GraphWarning,
        stacklevel=4,
    )
    return replace(graph, initial=estimate) if is_placed.all() else graph


def _placed_along_edges(
    graph: PoseGraph, estimate: Poses, is_known: BoolArray
) -> tuple[Poses, BoolArray]:
    """Poses that edges lead to, round by round, and which are placed now, (k,)."""
    R = estimate.R.copy()
    t = estimate.t.copy()
    is_placed = is_known.copy()
    to_landmark = np.isin(graph.j, graph.landmarks)
    usable = np.flatnonzero(~graph.is_prior & (to_landmark | (graph.kappa > 0)) & (graph.tau > 0))
    i = graph.i[usable]
    j = graph.j[usable]
    while True:
        forward = is_placed[i] & ~is_placed[j]
        backward = is_placed[j] & ~is_placed[i] & ~to_landmark[usable]
        if not (forward | backward).any():
            return Poses(R, t), is_placed
        _, first = np.unique(np.where(forward, j, i)[forward | backward], return_index=True)
        chosen = np.flatnonzero(forward | backward)[first]
        start = np.where(forward[chosen], i[chosen], j[chosen])
        end = np.where(forward[chosen], j[chosen], i[chosen])
        R_step = graph.R_ij[usable[chosen]]
        t_step = graph.t_ij[usable[chosen]]
        inverse_t = -np.einsum("mba,mb->ma", R_step, t_step)
        is_forward = forward[chosen, None]
        R_step = np.where(is_forward[:, None], R_step, R_step.mT)
        t_step = np.where(is_forward, t_step, inverse_t)
        R[end] = R[start] @ R_step
        t[end] = t[start] + np.einsum("mab,mb->ma", R[start], t_step)
        is_placed[end] = True
