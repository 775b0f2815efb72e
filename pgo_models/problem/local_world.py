"""Priors far from zero, as GPS in UTM or ECEF coordinates, seen from a point among them.

A prior measures t_j - t_w - R_w p, with the world pose w and a position p in its frame. With p of
5e6 metres the matrix M has entries tau p p^T, whose rounding hides all that a bound could say of a
map of a few metres. But nothing asks where the world pose stands. If it stands at a point o of its
own frame instead, so that t_w becomes t_w + R_w o, then

    t_j - t_w - R_w p  =  t_j - (t_w + R_w o) - R_w (p - o):

the cost is the same function of the other poses, and a linear change of one unknown leaves bounds
and multipliers as they are. It is the same to the last bit of every measurement, as o is chosen so
that each p - o is exact in doubles; else the world pose stays where it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pgo_models.geometry.arrays import block_norms
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting

# The world pose is moved where positions are so many times as far from zero as they are from each
# other. The rounding of M grows with the square of that: up to 256 it is at most 7e4 units, which
# leaves gaps of 1e-11 or so. A map within a few hundred of its own sizes of zero stays as it is.
_FAR = 256.0


@dataclass(frozen=True, eq=False)
class LocalWorld:
    """A problem with far priors, and the same with the world pose at a point among them.

    Poses of the file, as users have them, have coordinates of 1e5 to 1e7 metres and the world pose
    at the identity. Local poses are as the local problem has them: with small coordinates.

    Parameters
    ----------
    whole : PGOProblem
        The problem as the file has it.
    problem : PGOProblem
        The local problem. Its M is T^T M T with the change of unknowns T.
    point : Array, (d,)
        Where its world pose stands in the frame of the priors.
    """

    whole: PGOProblem
    problem: PGOProblem
    point: Array

    @classmethod
    def of(cls, problem: PGOProblem) -> LocalWorld | None:
        """Return the local world of a problem, or None where its priors are not far from zero.

        Parameters
        ----------
        problem : PGOProblem
            A cost of poses of a graph. Rotations alone, and costs that solvers make in place of a
            `Weighting`, have none.

        Returns
        -------
        LocalWorld or None
            The local problem is made anew.
        """
        graph = problem.graph
        is_own_cost = isinstance(problem.weighting, Weighting)
        if graph.world is None or not is_own_cost or not problem.has_translations:
            return None
        point = point_among_priors(graph)
        if not point.any():
            return None
        local = PGOProblem(with_world_at(graph, point), problem.backend, problem.weighting)
        return cls(problem, local, point)

    def local_poses(self, poses: Poses) -> Poses:
        """Return poses of the file as the local problem has them, with the world pose at zero.

        Parameters
        ----------
        poses : Poses
            Poses of the whole problem, in any frame.

        Returns
        -------
        Poses
            The same, exactly where `keeps_exactly` says so.
        """
        return seen_from_point(poses, self._world, self.point)

    def keeps_exactly(self, poses: Poses) -> bool:
        """Return whether `local_poses` of these poses are the same poses without any rounding.

        Parameters
        ----------
        poses : Poses
            Poses of the whole problem.

        Returns
        -------
        bool
            It is so for poses of `poses_of_file` that are as far away as the priors are.
        """
        world = self._world
        t = poses.t[world]
        is_unturned = np.array_equal(poses.R[world], np.eye(poses.d))
        centre = t + self.point
        others = np.delete(poses.t, world, axis=0)
        is_exact = _is_exact_difference(t, -self.point).all()
        return bool(is_unturned and is_exact and _is_exact_difference(others, centre).all())

    def poses_of_file(self, poses: Poses) -> Poses:
        """Return local poses in the frame of the priors, each coordinate rounded once.

        Parameters
        ----------
        poses : Poses
            Poses of the local problem, in any frame.

        Returns
        -------
        Poses
            Poses of the whole problem, with the world pose at the identity.
        """
        local = self._unturned(poses)
        t = local.t + self.point
        t[self._world] = 0.0
        return local.with_translations(t)

    def unrounded_poses(self, poses: Poses) -> Poses:
        """Return local poses as the whole problem has them, with their small coordinates.

        Parameters
        ----------
        poses : Poses
            Poses of the local problem, in any frame.

        Returns
        -------
        Poses
            Poses of the whole problem. Their frame has its zero at the point, and the world pose
            where that leaves it, at minus the point: no coordinate is rounded.
        """
        local = self._unturned(poses)
        t = local.t.copy()
        t[self._world] = -self.point
        return local.with_translations(t)

    def _unturned(self, poses: Poses) -> Poses:
        """Local poses in the frame whose axes and zero are those of the world pose, to the bit."""
        poses = poses.with_gauge_at(self._world)
        R = poses.R.copy()
        R[self._world] = np.eye(poses.d)
        return Poses(R, poses.t)

    @property
    def _world(self) -> int:
        world = self.problem.graph.world
        assert world is not None
        return world


def point_among_priors(graph: PoseGraph) -> Array:
    """Return a point that far priors are near to, (d,); zero along axes on which they are not far.

    That is the `far_middle` of the measured positions. Along an axis where the difference of one of
    them to it is not exact in doubles there is none.

    Parameters
    ----------
    graph : PoseGraph
        A graph with a world pose.

    Returns
    -------
    Array, (d,)
        The point, in the frame of the priors.
    """
    is_prior = graph.is_prior
    point = far_middle(graph.t_ij[is_prior & (graph.tau > 0)], graph)
    is_exact = _is_exact_difference(graph.t_ij[is_prior], point).all(axis=0)
    return np.where(is_exact, point, 0.0)


def far_middle(positions: Array, graph: PoseGraph) -> Array:
    """Return the middle of positions, (d,), along axes on which it is far from zero; else zero.

    That is their median, so that a few wrong ones do not matter, rounded to a power of two of about
    their spread: with so few digits the difference of most numbers to it is exact.

    Parameters
    ----------
    positions : Array, (k, d)
        Positions of poses, metres.
    graph : PoseGraph
        Their graph. Far is what is many times the spread of the positions and the length of edges.

    Returns
    -------
    Array, (d,)
        The middle.
    """
    if not len(positions):
        return np.zeros(graph.d)
    with np.errstate(over="ignore", invalid="ignore"):
        middle = np.median(positions, axis=0)
        spread = np.median(np.abs(positions - middle), axis=0).max()
        size = max(float(spread), _usual_length(graph))
        unit = 2.0 ** np.ceil(np.log2(size)) if size > 0.0 else 1.0
        rounded = np.round(middle / unit) * unit
        is_far = np.isfinite(rounded) & (np.abs(middle) > _FAR * size)
    return np.where(is_far, rounded, 0.0)


def _usual_length(graph: PoseGraph) -> float:
    """Median length of the measured translations between poses."""
    lengths = block_norms(graph.t_ij[~graph.is_prior])
    return float(np.median(lengths)) if len(lengths) else 0.0


def with_world_at(graph: PoseGraph, point: Array) -> PoseGraph:
    """Return the graph whose world pose stands at a point of its own frame.

    Parameters
    ----------
    graph : PoseGraph
        A graph with a world pose.
    point : Array, (d,)
        The point, metres.

    Returns
    -------
    PoseGraph
        The same measurements, those of priors seen from the point. Its estimates have the point at
        zero.
    """
    world = graph.world
    assert world is not None
    t_ij = graph.t_ij.copy()
    t_ij[graph.is_prior] -= point
    initial = None if graph.initial is None else seen_from_point(graph.initial, world, point)
    truth = None if graph.truth is None else seen_from_point(graph.truth, world, point)
    return replace(graph, t_ij=t_ij, initial=initial, truth=truth)


def seen_from_point(poses: Poses, world: int, point: Array) -> Poses:
    """Return poses with the world pose at a point of its own frame, and all seen from there.

    Parameters
    ----------
    poses : Poses
        Poses of a graph with a world pose.
    world : int
        Number of the world pose.
    point : Array, (d,)
        The point in the frame of the world pose.

    Returns
    -------
    Poses
        With the same rotations, and the world pose at zero.
    """
    t = poses.t.copy()
    t[world] += poses.R[world] @ point
    return poses.with_translations(t - t[world])


def _is_exact_difference(a: Array, b: Array) -> BoolArray:
    """Whether a - b is exact in doubles, entry by entry: its error (Knuth, TwoSum) is zero."""
    difference = a - b
    virtual = difference - a
    error = (a - (difference - virtual)) - (b + virtual)
    return np.asarray(error == 0.0)
