"""How far robots eliminate: all of their interiors, or less.

Eliminating the last poses of an interior couples all poses around it, and the robot's Schur
complement becomes dense. Robots may leave these poses to the driver (`solvers.soc.subdomains`),
whose system is then larger and sparse. Robots of one graph do so where their messages become
shorter and the driver has little to do all the same. They and robots with files of their own, which
otherwise keep interiors to themselves, do so where the fronts of groups of robots would take the
driver long and its sparse system is cheaper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgo_models.graphs.pose_graph import IntArray, edge_counts, middle_node
from pgo_models.problem.cholesky import CholeskyBackend, default_backend
from solvers.distributed.interface import Interface
from solvers.distributed.multifrontal import FrontOwners, flops_of_fronts
from solvers.distributed.robots.subdomain_blocks import Widths
from solvers.distributed.sparse_interface import CoverPattern, SparseInterface
from solvers.network.ledger import BYTES_PER_NUMBER
from solvers.soc.subgraph import RobotSummary, Subgraph

# Operations of a factorisation by fronts from which another way is tried; LAPACK takes about 0.15
# CPU seconds for so many on one thread of a processor of 2023.
ENOUGH_FLOPS = 5e9
# Poses that a robot couples at most by eliminating one where it leaves poses to the driver. Between
# 8 and 32 the driver of 16 robots in the plane, 20,000 poses that interleave, takes 0.80e9 to
# 0.96e9 operations, and the robots send 3.8 to 7.8 MB. With 4, 8, 16 and 32 a certified solve by 25
# robots sends 15.8, 16.6, 21.4 and 32.4 MB on sphere2500 (81.3 where all is eliminated), and with
# 4, 8 and 16 it sends 4.2, 3.9 and 4.1 MB on M3500.
MOST_COUPLED = 8
# Numbers sent for one factor from which robots try to make their messages shorter: 80 kB. Less is
# not worth the search.
ENOUGH_NUMBERS = 10_000
# How often driver and robots exchange vectors on the boundaries with one factor: a solve makes five
# factors in 11 to 22 rounds.
_EXCHANGES = 3


@dataclass(frozen=True, eq=False)
class CoverSystem:
    """What the robots' summaries say of the driver's system.

    A robot without edges touches nothing; one whose edges have no end in the cover touches no pose.
    """

    cover: IntArray  # (g,): numbers of its poses, ascending
    touched: tuple[IntArray, ...]  # as `Interface.touched`
    coupled: tuple[IntArray, ...] | None  # as `RobotSummary.coupled`; None where it has fronts
    width: int  # numbers per pose

    @classmethod
    def of(cls, summaries: Sequence[RobotSummary]) -> CoverSystem:
        """System of the robots with edges."""
        touched = []
        coupled = []
        for robot in summaries:
            if robot.touched is not None:
                touched.append(robot.touched)
            if robot.coupled is not None:
                coupled.append(robot.coupled)
        return cls(
            cover=np.unique(np.concatenate([robot.cover for robot in summaries])),
            touched=tuple(touched),
            coupled=tuple(coupled) if coupled else None,
            width=summaries[0].d + 1,
        )

    @property
    def flops(self) -> float:
        """Operations of a factorisation, one after the other: what robots do at a time counts once.

        Where the system is sparse the driver does them all.
        """
        if self.coupled is None:
            return flops_of_fronts(FrontOwners(self.touched, len(self.cover)), self.width)
        return self.pattern.flops(self.width)

    @cached_property
    def pattern(self) -> CoverPattern:
        """Pattern of a sparse system."""
        assert self.coupled is not None
        return CoverPattern.of(self.touched, self.coupled, len(self.cover), self.width - 1)

    @property
    def num_sent(self) -> int:
        """Numbers sent for one factor: Schur complements, and vectors on boundaries both ways."""
        d = self.width - 1
        num_entries = sum(self.interface((1, d)).num_entries)
        num_touched = sum(len(poses) for poses in self.touched)
        return num_entries + 2 * _EXCHANGES * d * (d + 1) * num_touched

    @property
    def middle(self) -> int:
        """Position in the cover of a pose in the middle, by the number of steps between poses.

        A step joins two poses that the robots couple, or where the driver is not told these, two
        that a robot touches. Bounds are proved with that pose left out: the smallest eigenvalue of
        what remains is much smaller where a pose at the rim is.
        """
        g = len(self.cover)
        if self.coupled is not None:
            rows, columns = self.pattern.lower.tocoo().coords
            return middle_node(edge_counts(rows, columns, g))
        # A node for every robot, which joins the poses that it touches.
        robots = np.repeat(np.arange(len(self.touched)), [len(poses) for poses in self.touched])
        adjacency = edge_counts(np.concatenate(self.touched), g + robots, g + len(self.touched))
        middle = middle_node(adjacency)
        if middle < g:
            return middle
        return int(adjacency.indices[adjacency.indptr[middle]])

    def interface(self, widths: Widths) -> Interface:
        """The system for unknowns with these numbers per pose; all fronts are with the driver."""
        g = len(self.cover)
        if self.coupled is None:
            return Interface(g, widths, self.touched, FrontOwners(self.touched, g))
        no_fronts = FrontOwners((), g)
        return SparseInterface(g, widths, self.touched, no_fronts, pattern=self.pattern)


def may_leave_poses(system: CoverSystem) -> bool:
    """Whether fronts take so long that robots should try to leave poses to the driver."""
    return has_cholmod() and system.flops >= ENOUGH_FLOPS


def has_cholmod() -> bool:
    """Whether there is CHOLMOD (extra `fast`), which factors what robots leave fast enough."""
    return default_backend() is CholeskyBackend.CHOLMOD


def choose_elimination(subgraphs: Sequence[Subgraph]) -> tuple[Subgraph, ...]:
    """Return the subgraphs of one graph with the cover that suits driver and robots better.

    The larger one is tried where messages are long, and longer than a list of all edges, or fronts
    take long (`may_leave_poses`). It is chosen where messages become shorter and the driver takes
    few operations, or where fronts take long and it takes fewer.
    """
    system = CoverSystem.of([subgraph.summary for subgraph in subgraphs])
    num_sent = system.num_sent
    num_bytes = BYTES_PER_NUMBER * num_sent
    are_short = num_sent < ENOUGH_NUMBERS or num_bytes <= bytes_of_edges(subgraphs)
    takes_long = may_leave_poses(system)
    if not has_cholmod() or (are_short and not takes_long):
        return tuple(subgraphs)
    larger = leave_poses(subgraphs, MOST_COUPLED)
    sparse = CoverSystem.of([subgraph.summary for subgraph in larger])
    is_shorter = sparse.num_sent < num_sent and sparse.flops < ENOUGH_FLOPS
    is_quicker = takes_long and sparse.flops < system.flops
    return larger if is_shorter or is_quicker else tuple(subgraphs)


def bytes_of_edges(subgraphs: Sequence[Subgraph]) -> int:
    """Bytes of a list of all edges, each a relative pose and the two precisions of F."""
    d = subgraphs[0].graph.d
    num_edges = sum(int(subgraph.is_counted.sum()) for subgraph in subgraphs)
    return BYTES_PER_NUMBER * num_edges * (d * (d + 1) // 2 + 2)


def leave_poses(subgraphs: Sequence[Subgraph], most_coupled: int) -> tuple[Subgraph, ...]:
    """Return the subgraphs of robots that leave poses to the driver (`Subgraph.poses_left`)."""
    left = [subgraph.poses_left(most_coupled) for subgraph in subgraphs]
    held = [
        subgraph.held_cover(of_robot) for subgraph, of_robot in zip(subgraphs, left, strict=True)
    ]
    return tuple(
        subgraph.with_larger_cover(of_robot, positions)
        for subgraph, of_robot, positions in zip(
            subgraphs, left, positions_in_cover(held), strict=True
        )
    )


def positions_in_cover(held: Sequence[IntArray]) -> list[IntArray]:
    """Positions, in the cover of all robots, of the poses of it that every robot holds."""
    cover = np.unique(np.concatenate(held))
    return [np.searchsorted(cover, poses) for poses in held]
