"""The driver's matrix, eliminated in a tree of groups of robots: dense fronts, the multifrontal method (Liu 1992).

Recursive bisection of the robot adjacency graph, by how many separators robots share. A separator pose is eliminated at
the smallest group that holds every robot which touches it: no dense matrix over all separators is formed. The driver
holds the front of all robots, the root; those below are held by robots where there are many large ones.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import Any, TypeVar

import numpy as np
from scipy.sparse import csr_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from solvers.distributed.robots.agent import order_front, take_front
from solvers.distributed.robots.elimination import FrontParts, HeldFront
from solvers.distributed.robots.records import ALONG_TREE
from solvers.network.counted_pool import Count, CountedPool
from solvers.network.ledger import DRIVER
from solvers.network.messages import Idle

Q = TypeVar("Q")
A = TypeVar("A")
LEAST = 200  # separators of a front that is worth messages of its own
FEW = 8  # fewer such fronts are held by the driver
_SPECTRAL = 300  # robots; more are halved in their order


@dataclass(frozen=True, eq=False)
class Front:
    """One group of robots, of at least two unless there is but one."""

    robots: tuple[int, ...]  # whose contributions are added here
    children: tuple[int, ...]  # earlier fronts, whose Schur complements are added here
    # eliminated, boundary: (e,), (b,); separators that only this group touches and that no child has eliminated; those
    # left to groups above.
    eliminated: IntArray
    boundary: IntArray
    level: int  # one above its highest child's; 1 where there is none

    @property
    def separators(self) -> IntArray:
        """Rows of the front: eliminated, then boundary."""
        return np.concatenate([self.eliminated, self.boundary])


def separator_tree(touched: Sequence[IntArray], num_separators: int, least: int = 0) -> tuple[Front, ...]:
    """Fronts in order of their levels, so that children come first; the last one holds all robots.

    `touched` are the separators, 0 .. num_separators - 1, that every robot touches, (g_a,) each. What would be a front
    of fewer than `least` separators is left to the next one above.
    """
    robot = np.repeat(np.arange(len(touched)), [len(poses) for poses in touched])
    pose = np.concatenate([*touched, np.zeros(0, dtype=np.int64)])
    touches = csr_array((np.ones(len(pose)), (robot, pose)), shape=(len(touched), num_separators))
    shared = (touches @ touches.T).toarray()
    left_to_touch = np.bincount(pose, minlength=num_separators)
    fronts: list[Front] = []

    def combined(robots: tuple[int, ...], children: tuple[int, ...], inside: IntArray, left: IntArray) -> None:
        level = 1 + max((fronts[child].level for child in children), default=0)
        fronts.append(Front(robots, children, inside, left, level))

    def grow(group: IntArray) -> tuple[tuple[int, ...], tuple[int, ...], IntArray, IntArray]:
        """Robots and fronts of a group that the one above adds, the separators they leave, and how many touch each."""
        if len(group) == 1:
            return (int(group[0]),), (), touched[group[0]], np.ones(len(touched[group[0]]), dtype=np.int64)
        one, other = (grow(half) for half in _halves(group, shared))
        robots, children = one[0] + other[0], one[1] + other[1]
        poses, place = np.unique(np.concatenate([one[2], other[2]]), return_inverse=True)
        counts = np.bincount(place, weights=np.concatenate([one[3], other[3]])).astype(np.int64)
        is_inside = counts == left_to_touch[poses]
        if not is_inside.any() or len(poses) < least:
            return robots, children, poses, counts
        combined(robots, children, poses[is_inside], poses[~is_inside])
        return (), (len(fronts) - 1,), poses[~is_inside], counts[~is_inside]

    if touched:
        robots, children, left, _ = grow(np.arange(len(touched)))
        if robots or len(children) > 1:
            combined(robots, children, left, left[:0])
    order = sorted(range(len(fronts)), key=lambda number: fronts[number].level)
    after = np.argsort(order).tolist()
    return tuple(replace(fronts[k], children=tuple(after[child] for child in fronts[k].children)) for k in order)


def _halves(group: IntArray, shared: Array) -> tuple[IntArray, IntArray]:
    """Two halves of a group that share few separators: by the Fiedler vector of who shares with whom."""
    middle = len(group) // 2
    if not 2 < len(group) <= _SPECTRAL:
        return group[:middle], group[middle:]
    weight = shared[np.ix_(group, group)]
    np.fill_diagonal(weight, 0.0)
    fiedler = np.linalg.eigh(np.diag(weight.sum(axis=0)) - weight)[1][:, 1]
    order = np.lexsort((group, np.round(fiedler, 9)))
    return np.sort(group[order[:middle]]), np.sort(group[order[middle:]])


def levels(tree: Sequence[Front]) -> list[list[int]]:
    """Numbers of the fronts of every level."""
    return [list(one) for _, one in groupby(range(len(tree)), lambda number: tree[number].level)]


class FrontOwners:
    """Fronts of the tree of robots that touch these separators; the driver holds all, until they are handed out."""

    def __init__(self, touched: Sequence[IntArray], num_separators: int) -> None:
        tree = separator_tree(touched, num_separators, LEAST)
        self._is_shared = len(tree) >= FEW
        self.tree = tree = tree if self._is_shared else separator_tree(touched, num_separators)
        self.owner, self.held = [DRIVER] * len(tree), {}
        self._robots: list[int] = []
        for number, front in enumerate(tree):
            order = np.argsort(front.separators)
            parts = [touched[robot] for robot in front.robots] + [tree[child].boundary for child in front.children]
            places = tuple(order[np.searchsorted(front.separators, part, sorter=order)] for part in parts)
            self.held[number] = HeldFront(len(front.eliminated), len(order), places, len(front.robots))

    def hand_out(self, network: CountedPool, robots: IntArray) -> None:
        """Give every front but the root to a robot of its group, none two, if there are not few.

        `robots` are the numbers in the network of those who touch separators.
        """
        if not self._is_shared:
            return
        self._network, self._robots, network.elsewhere = network, robots.tolist(), ALONG_TREE
        free: list[list[int]] = []  # robots of every group that hold no front yet
        given: list[HeldFront | None] = [None] * network.ledger.num_robots
        for number, front in enumerate(self.tree[:-1]):
            owner, *others = [*front.robots, *(robot for child in front.children for robot in free[child])]
            free.append(others)
            self.owner[number] = self._robots[owner]
            given[self._robots[owner]] = self.held.pop(number)
        network.ask(take_front, given, Count.OFF)

    def ask(self, order: Callable[[HeldFront, Q], tuple[HeldFront, A]], requests: Mapping[int, Q]) -> Mapping[int, A]:
        """Answers of fronts of one level, by their numbers, to an order, each with its request."""
        answers: dict[int, A] = {}
        for number in self.held.keys() & requests.keys():
            self.held[number], answers[number] = order(self.held[number], requests[number])
        asked = {self.owner[number]: number for number in requests if number not in answers}
        if asked:
            robots = range(self._network.ledger.num_robots)
            to_all = [requests[asked[one]] if one in asked else Idle.IDLE for one in robots]
            found = self._network.workers.ask(partial(order_front, order), to_all)
            answers.update({number: found[robot] for robot, number in asked.items()})
        if self._is_shared:
            links = [link for number in requests for link in self._links(number, requests[number], answers[number])]
            level = self.tree[next(iter(requests))].level
            sender, receiver, numbers = np.array(links).T
            self._network.count(sender, receiver, numbers, is_round=False, level=level)
        return answers

    def _links(self, number: int, request: Any, answer: Any) -> list[tuple[int, int, int]]:  # noqa: ANN401 - as ordered
        """Sender, receiver and numbers of what a front takes and gives."""
        own, front = self.owner[number], self.tree[number]
        below = [*(self._robots[robot] for robot in front.robots), *(self.owner[child] for child in front.children)]
        if isinstance(request, FrontParts):  # its parts; of the driver; |y|^2
            links = [(one, own, part.size) for one, part in zip(below, request.parts, strict=True)]
            links.append((DRIVER, own, request.own.size if request.own is not None else 0))
            return [*links, (own, DRIVER, int(isinstance(answer, tuple)))]
        return [(own, DRIVER, answer[0].size), *((own, one, x.size) for one, x in zip(below, answer[1], strict=True))]
