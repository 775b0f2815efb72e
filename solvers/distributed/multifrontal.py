"""The driver's matrix, eliminated in a tree of groups of robots (multifrontal method, Liu 1992).

Fronts are dense. The groups come from recursive bisection of the robot adjacency graph, by how many
separators robots share. A separator pose is eliminated at the smallest group that holds every robot
which touches it: no dense matrix over all separators is formed. The driver holds the front of all
robots, the root; those below are held by robots where there are many large ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import Any, TypeVar
from weakref import WeakSet

import numpy as np
from scipy.sparse import csr_array

from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from solvers.distributed.robots.agent import order_front, take_front
from solvers.distributed.robots.elimination import FrontParts, HeldFront
from solvers.distributed.robots.records import ALONG_TREE
from solvers.network.counted_pool import Count, CountedPool
from solvers.network.ledger import BYTES_PER_NUMBER, DRIVER
from solvers.network.messages import Idle

Q = TypeVar("Q")
A = TypeVar("A")
LEAST_SEPARATORS = 200  # of a front that is worth messages of its own
LEAST_FRONTS = 8  # fewer such fronts are all held by the driver
_MOST_SPECTRAL = 300  # robots in a group; more are halved in their order


@dataclass(frozen=True, eq=False)
class Front:
    """One group of robots, of at least two unless there is but one."""

    robots: tuple[int, ...]  # whose contributions are added here
    children: tuple[int, ...]  # earlier fronts, whose Schur complements are added here
    # eliminated, boundary: (e,), (b,); separators that only this group touches and that no child
    # has eliminated; those left to groups above.
    eliminated: IntArray
    boundary: IntArray
    level: int  # one above its highest child's; 1 where there is none

    @property
    def separators(self) -> IntArray:
        """Rows of the front: eliminated, then boundary."""
        return np.concatenate([self.eliminated, self.boundary])


def separator_tree(
    touched: Sequence[IntArray], num_separators: int, least: int = 0
) -> tuple[Front, ...]:
    """Build the fronts in order of their levels, so that children come first; the last is the root.

    `touched` are the separators, 0 .. num_separators - 1, that every robot touches, (g_a,) each.
    What would be a front of fewer than `least` separators is left to the next one above.
    """
    if not touched:
        return ()
    builder = _TreeBuilder(touched, num_separators, least)
    robots = np.arange(len(touched))
    rest = builder.grow(robots)
    if rest.robots or len(rest.children) > 1:
        builder.add_front(rest, np.ones(len(rest.separators), dtype=bool))
    return _sorted_by_level(builder.fronts)


@dataclass(frozen=True, eq=False)
class _Group:
    """What a group of robots leaves to the one above it."""

    robots: tuple[int, ...]  # whose contributions are in no front yet
    children: tuple[int, ...]  # fronts that are in no front yet
    separators: IntArray  # (b,): that are not eliminated yet
    num_touching: IntArray  # (b,): robots of the group that touch them

    def joined(self, other: _Group) -> _Group:
        """Return both groups as one."""
        separators, place = np.unique(
            np.concatenate([self.separators, other.separators]), return_inverse=True
        )
        weights = np.concatenate([self.num_touching, other.num_touching])
        num_touching = np.bincount(place, weights=weights).astype(np.int64)
        return _Group(
            self.robots + other.robots, self.children + other.children, separators, num_touching
        )


class _TreeBuilder:
    """Fronts of a `separator_tree` as they are made, children first."""

    def __init__(self, touched: Sequence[IntArray], num_separators: int, least: int) -> None:
        robot = np.repeat(np.arange(len(touched)), [len(poses) for poses in touched])
        pose = np.concatenate(touched)
        shape = (len(touched), num_separators)
        touches = csr_array((np.ones(len(pose)), (robot, pose)), shape=shape)
        self.touched = touched
        self.least = least
        self.shared = (touches @ touches.T).toarray()  # separators that two robots share
        self.num_touching = np.bincount(pose, minlength=num_separators)
        self.fronts: list[Front] = []

    def grow(self, robots: IntArray) -> _Group:
        """Make the fronts of a group, half by half."""
        if len(robots) == 1:
            separators = self.touched[robots[0]]
            once = np.ones(len(separators), dtype=np.int64)
            return _Group((int(robots[0]),), (), separators, once)
        half, other_half = _halves(robots, self.shared)
        group = self.grow(half).joined(self.grow(other_half))
        is_inside = group.num_touching == self.num_touching[group.separators]
        if not is_inside.any() or len(group.separators) < self.least:
            return group
        self.add_front(group, is_inside)
        number = len(self.fronts) - 1
        return _Group((), (number,), group.separators[~is_inside], group.num_touching[~is_inside])

    def add_front(self, group: _Group, is_inside: BoolArray) -> None:
        """Add the front that eliminates those separators of a group that are inside of it."""
        below = [self.fronts[child].level for child in group.children]
        front = Front(
            robots=group.robots,
            children=group.children,
            eliminated=group.separators[is_inside],
            boundary=group.separators[~is_inside],
            level=1 + max(below, default=0),
        )
        self.fronts.append(front)


def _sorted_by_level(fronts: Sequence[Front]) -> tuple[Front, ...]:
    """Sort fronts by their levels, and number their children anew."""
    order = sorted(range(len(fronts)), key=lambda number: fronts[number].level)
    new_number = np.argsort(order).tolist()
    tree: list[Front] = []
    for number in order:
        front = fronts[number]
        children = tuple(new_number[child] for child in front.children)
        tree.append(replace(front, children=children))
    return tuple(tree)


def _halves(group: IntArray, shared: Array) -> tuple[IntArray, IntArray]:
    """Halve a group so that the halves share few separators: by the Fiedler vector of `shared`."""
    middle = len(group) // 2
    if not 2 < len(group) <= _MOST_SPECTRAL:
        return group[:middle], group[middle:]
    weight = shared[np.ix_(group, group)]
    np.fill_diagonal(weight, 0.0)
    laplacian = np.diag(weight.sum(axis=0)) - weight
    _, vectors = np.linalg.eigh(laplacian)
    fiedler = vectors[:, 1]
    order = np.lexsort((group, np.round(fiedler, 9)))
    return np.sort(group[order[:middle]]), np.sort(group[order[middle:]])


def levels(tree: Sequence[Front]) -> list[list[int]]:
    """Return the numbers of the fronts of every level."""
    by_level = groupby(range(len(tree)), lambda number: tree[number].level)
    return [list(numbers) for _, numbers in by_level]


def flops_of_fronts(fronts: FrontOwners, width: int) -> float:
    """Operations of a factorisation with so many unknowns per pose.

    Where robots hold the fronts, those of one level are eliminated at the same time, and the
    largest of them counts.
    """
    flops = []
    for front in fronts.tree:
        e = float(width * len(front.eliminated))
        b = float(width * len(front.boundary))
        flops.append(e**3 / 3.0 + e**2 * b + e * b**2)
    if not fronts.is_shared:
        return sum(flops)
    return sum(max(flops[number] for number in level) for level in levels(fronts.tree))


@dataclass(frozen=True, eq=False)
class FactorName:
    """Number under which the fronts hold a factor, as long as this object lives."""

    number: int


class FrontOwners:
    """The tree of fronts, and who holds which; the driver holds all, until they are handed out."""

    def __init__(self, touched: Sequence[IntArray], num_separators: int) -> None:
        tree = separator_tree(touched, num_separators, LEAST_SEPARATORS)
        self.is_shared = len(tree) >= LEAST_FRONTS
        if not self.is_shared:
            tree = separator_tree(touched, num_separators)
        self.tree = tree
        self.owner = [DRIVER] * len(tree)
        self.held = {number: _held_front(tree, front, touched) for number, front in enumerate(tree)}
        self._robots: list[int] = []
        self._num_factors = 0
        self._names: WeakSet[FactorName] = WeakSet()

    def new_factor(self) -> FactorName:
        """Name a factor that is to be computed."""
        name = FactorName(self._num_factors)
        self._num_factors += 1
        self._names.add(name)
        return name

    @property
    def factors_in_use(self) -> tuple[int, ...]:
        """Numbers of the factors whose names are alive."""
        return tuple(sorted(name.number for name in self._names))

    def hand_out(self, network: CountedPool, robots: IntArray) -> None:
        """Give every front but the root to a robot of its group, none two, if there are not few.

        `robots` are the numbers in the network of those who touch separators.
        """
        if not self.is_shared:
            return
        self._network = network
        self._robots = robots.tolist()
        network.elsewhere = ALONG_TREE
        free: list[list[int]] = []  # robots of every group that hold no front yet
        given: list[HeldFront | None] = [None] * network.ledger.num_robots
        for number, front in enumerate(self.tree[:-1]):
            of_children = [robot for child in front.children for robot in free[child]]
            owner, *others = [*front.robots, *of_children]
            free.append(others)
            self.owner[number] = self._robots[owner]
            given[self._robots[owner]] = self.held.pop(number)
        network.ask(take_front, given, Count.OFF)

    def ask(
        self, order: Callable[[HeldFront, Q], tuple[HeldFront, A]], requests: Mapping[int, Q]
    ) -> Mapping[int, A]:
        """Return the answers of fronts of one level to an order, by their numbers."""
        answers: dict[int, A] = {}
        for number in self.held.keys() & requests.keys():
            self.held[number], answers[number] = order(self.held[number], requests[number])
        number_of = {self.owner[number]: number for number in requests if number not in answers}
        if number_of:
            to_all: list[Q | Idle] = [Idle.IDLE] * self._network.ledger.num_robots
            for robot, number in number_of.items():
                to_all[robot] = requests[number]
            of_all = self._network.workers.ask(partial(order_front, order), to_all)
            answers.update({number: of_all[robot] for robot, number in number_of.items()})
        if self.is_shared:
            self._count(requests, answers)
        return answers

    def _count(self, requests: Mapping[int, Any], answers: Mapping[int, Any]) -> None:
        """Enter what the fronts of a level were sent and answered into the ledger."""
        links: list[tuple[int, int, int]] = []
        for number, request in requests.items():
            links += self._links(number, request, answers[number])
        level = self.tree[next(iter(requests))].level
        sender, receiver, sizes = np.array(links).T
        self._network.count(sender, receiver, sizes, is_round=False, level=level)

    def _links(self, number: int, request: Any, answer: Any) -> list[tuple[int, int, int]]:  # noqa: ANN401 - as ordered
        """Sender, receiver and bytes of what a front is sent and answers."""
        own = self.owner[number]
        front = self.tree[number]
        of_robots = [self._robots[robot] for robot in front.robots]
        of_children = [self.owner[child] for child in front.children]
        below = [*of_robots, *of_children]
        _, content = request
        if isinstance(content, FrontParts):  # its parts; the driver's; |y|^2 to the driver
            links = [
                (sender, own, part.nbytes)
                for sender, part in zip(below, content.parts, strict=True)
            ]
            links.append((DRIVER, own, content.own.nbytes if content.own is not None else 0))
            links.append((own, DRIVER, BYTES_PER_NUMBER * isinstance(answer, tuple)))
            return links
        x_E, on_parts = answer
        to_below = [(own, receiver, x.nbytes) for receiver, x in zip(below, on_parts, strict=True)]
        return [(own, DRIVER, x_E.nbytes), *to_below]


def _held_front(tree: Sequence[Front], front: Front, touched: Sequence[IntArray]) -> HeldFront:
    """Place the parts of a front in it."""
    of_robots = [touched[robot] for robot in front.robots]
    of_children = [tree[child].boundary for child in front.children]
    order = np.argsort(front.separators)
    places = [
        order[np.searchsorted(front.separators, part, sorter=order)]
        for part in (*of_robots, *of_children)
    ]
    return HeldFront(len(front.eliminated), len(order), tuple(places), len(front.robots))
