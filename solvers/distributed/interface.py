"""Interface problem of substructuring: the sum of the robots' Schur complements, factored along a tree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.floating_point import OUTWARD, column_error, gamma
from pgo_models.problem.matrices import columns_of
from solvers.distributed.multifrontal import FrontOwners, levels
from solvers.distributed.robots.elimination import FrontParts, HeldFront, Widths

_AT_WORK = 4.25  # times a front: itself, and copies of what is added to it or split off from it

Solved = tuple[Array, list[Array], float]


@dataclass(frozen=True, eq=False)
class Interface:
    """The sum's matrix for one kind of unknowns: how they are stacked, and who touches which separators."""

    num_separators: int
    widths: Widths
    touched: tuple[IntArray, ...]  # (g_a,) each: separators that every robot touches, ascending
    fronts: FrontOwners

    @property
    def side(self) -> int:
        """Number of unknowns."""
        return sum(self.widths) * self.num_separators

    @cached_property
    def columns(self) -> tuple[IntArray, ...]:
        """Columns of every robot's boundary, each (g_a sum(widths),)."""
        return tuple(columns_of(poses, self.num_separators, self.widths) for poses in self.touched)

    @property
    def num_bytes(self) -> int:
        """Memory for the robots' contributions, the fronts at work and the factor, known before any of it is spent."""
        width, tree = sum(self.widths), self.fronts.tree
        kept = waiting = most = 0.0
        for front in tree:
            e, b = len(front.eliminated), len(front.boundary)
            most = max(most, kept + waiting + _AT_WORK * (e + b) ** 2)
            waiting += 0.5 * b**2 - sum(0.5 * len(tree[child].boundary) ** 2 for child in front.children)
            kept += e * (e + b)
        sides = [width * len(poses) for poses in self.touched]
        own = self.side * (width + 4)  # blocks of the driver, and orders of the unknowns
        return int(8 * (width**2 * most + sum(side * (side + 1) // 2 for side in sides) + own))

    def check_memory(self, limit: float) -> None:
        """Refuse before the memory is spent: a SettingError when `num_bytes` is above `limit`."""
        if self.num_bytes > limit:
            raise SettingError(
                f"the driver, and robots that hold fronts for it, would need {1e-9 * self.num_bytes:.2g} GB for "
                f"{self.num_separators} separators, more than {1e-9 * limit:.2g} GB: they are solved for in the start, "
                "Newton and the certificate, whatever the coupling; use a METIS partition or fewer robots, raise "
                "driver_memory (--driver-memory), or set it to 0: CONSENSUS without a driver, which gives poses and no "
                "certificate"
            )

    def factorize(self, contributions: Sequence[Array], own: Sequence[tuple[IntArray, Array]] = ()) -> Interface:
        """Sum the robots' Schur complements and the driver's own blocks, and factor, front by front; for `solve`.

        The factor takes the place of the one before: a driver has one `Interface` for all unknowns of these widths.

        The contributions, (g (g + 1) / 2,) for a robot with g columns, are as `Elimination.schur`; the driver's own are
        pairs of columns (q, w) and values (q, w, w), each block on unknowns of one separator. A
        NotPositiveDefiniteError when the sum is not positive definite.
        """
        width = sum(self.widths)
        place = np.empty(self.side, dtype=np.int64)
        place[self.order] = np.arange(self.side)
        blocks = np.zeros((self.num_separators, width, width))
        for columns, values in own:
            separator, number = np.divmod(place[columns], width)
            np.add.at(blocks, (separator[:, :1, None], number[:, :, None], number[:, None, :]), values)
        schur: dict[int, Array] = {}
        for level in levels(self.fronts.tree):
            schur.update(self.fronts.ask(HeldFront.eliminate, self._orders(level, contributions, schur, blocks)))
        return self

    def solve(self, parts: Sequence[Array], own: Array | None = None) -> Solved:
        """Solution x, (side, k), for the sum of the robots' right-hand sides and the driver's `own`, (side, k).

        With it x on every robot's boundary, and b^T x.
        """
        k, width, energy = parts[0].shape[1], sum(self.widths), 0.0
        blocks = own[self.order].reshape(-1, width, k) if own is not None else None
        left: dict[int, Array] = {}
        for level in levels(self.fronts.tree):
            reduced = self.fronts.ask(HeldFront.reduce, self._orders(level, parts, left, blocks))
            left.update({number: b for number, (b, _) in reduced.items()})
            energy += math.fsum(one for _, one in reduced.values())
        x, on_parts, known = np.empty((self.num_separators, width, k)), list(parts), left  # of the root: nothing
        for level in reversed(levels(self.fronts.tree)):
            asked = {number: (known.pop(number), self.widths) for number in level}
            for number, (found, below) in self.fronts.ask(HeldFront.substitute, asked).items():
                front = self.fronts.tree[number]
                x[front.eliminated] = found.reshape(-1, width, k)
                for robot, part in zip(front.robots, below, strict=False):
                    on_parts[robot] = part
                known.update(zip(front.children, below[len(front.robots) :], strict=True))
        stacked = np.empty((self.side, k))
        stacked[self.order] = x.reshape(stacked.shape)
        return stacked, on_parts, energy

    def _orders(
        self, level: Sequence[int], robots: Sequence[Array], children: dict[int, Array], own: Array | None
    ) -> dict[int, FrontParts]:
        """What the fronts of a level are the sum of; the driver's part where there is any."""
        orders: dict[int, FrontParts] = {}
        for front in (self.fronts.tree[number] for number in level):
            below = *(robots[robot] for robot in front.robots), *(children.pop(child) for child in front.children)
            mine = own[front.eliminated] if own is not None else np.zeros(0)
            orders[level[len(orders)]] = FrontParts(self.widths, below, mine if mine.any() else None)
        return orders

    @cached_property
    def order(self) -> IntArray:
        """Unknowns, stacked field by field, in the order separator by separator."""
        count, first = self.num_separators, self.num_separators * np.cumsum((0, *self.widths))
        fields = [at + np.arange(w * count).reshape(count, w) for at, w in zip(first, self.widths, strict=False)]
        return np.concatenate(fields, axis=1).ravel()

    def rounding(self, sizes: Sequence[Array], own: Sequence[tuple[IntArray, Array]], diagonal: Array) -> Array:
        """Diagonal, (side,), that bounds what the factor of `factorize` can differ from the exact sum by.

        `own` are as there, `sizes`, (g,) each, the `row_sums` of the contributions in the scale of `diagonal`, (side,),
        which is at least the diagonal of the sum.
        """
        # Eliminated unknowns of every front that a separator is in, and one for every part that is added there.
        in_column, most, every = np.zeros(self.num_separators, dtype=np.int64), 0, sum(self.widths)
        for front in self.fronts.tree:
            in_column[front.separators] += every * len(front.eliminated) + len(front.robots) + len(front.children)
            most = max(most, every * len(front.separators))
        terms = np.concatenate([np.repeat(in_column, width) for width in self.widths]) + len(sizes)
        sums = self.gather([size[:, None] for size in sizes])[:, 0]
        for columns, values in own:
            root = np.sqrt(diagonal[columns])
            np.add.at(sums, columns, root * (np.abs(values) @ (1.0 / root)[:, :, None])[:, :, 0])
        largest = gamma(float(terms.max(initial=0)) + 8.0)
        shares: Array = largest * sums + column_error(terms.astype(float), float(most)) / (1.0 - largest) * diagonal
        return OUTWARD * shares

    def gather(self, parts: Sequence[Array]) -> Array:
        """Sum of the robots' vectors on their boundaries, (side, k)."""
        total = np.zeros((self.side, parts[0].shape[1]))
        for columns, part in zip(self.columns, parts, strict=True):
            total[columns] += part
        return total

    def scatter(self, x: Array) -> list[Array]:
        """What every robot is sent of a vector of the driver, each (g_a sum(widths), k)."""
        return [x[columns] for columns in self.columns]
