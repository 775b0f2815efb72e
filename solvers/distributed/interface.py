"""Interface problem of substructuring: the sum of Schur complements, factored along a tree.

An interface says which unknowns there are. Its factors are values: each stays as it is when another
one is computed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.floating_point import OUTWARD, column_error, gamma
from pgo_models.problem.matrices import columns_of
from solvers.distributed.multifrontal import FactorName, FrontOwners, levels
from solvers.distributed.robots.elimination import FrontMatrix, FrontParts, HeldFront
from solvers.distributed.robots.subdomain_blocks import Widths

# memory of a front at work, in fronts: itself, and copies of what is added to it or split off
_AT_WORK = 4.25

Solved = tuple[Array, list[Array], float]


class InterfaceFactor(Protocol):
    """A factor of the sum of the robots' Schur complements and the driver's own blocks."""

    def solve(self, parts: Sequence[Array], own: Array | None = None) -> Solved:
        """Solve for the sum of the robots' right-hand sides and the driver's `own`, (side, k).

        The answer is x, (side, k), x on every robot's boundary, and b^T x.
        """


@dataclass(frozen=True, eq=False)
class Interface:
    """The matrix of the sum, for one kind of unknowns."""

    num_separators: int
    widths: Widths  # numbers per separator in every field; fields are stacked
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
        """Memory for contributions, fronts at work and the factor, known before it is spent."""
        width = sum(self.widths)
        tree = self.fronts.tree
        # numbers, in separators squared: of the factor so far, and of complements that wait
        kept = 0.0
        waiting = 0.0
        most = 0.0
        for front in tree:
            e = len(front.eliminated)
            b = len(front.boundary)
            most = max(most, kept + waiting + _AT_WORK * (e + b) ** 2)
            added = sum(0.5 * len(tree[child].boundary) ** 2 for child in front.children)
            waiting += 0.5 * b**2 - added
            kept += e * (e + b)
        own = self.side * (width + 4)  # blocks of the driver, and orders of the unknowns
        return int(8 * (width**2 * most + sum(self.num_entries) + own))

    @property
    def num_entries(self) -> list[int]:
        """Numbers that every robot sends of its Schur complement."""
        sides = [sum(self.widths) * len(poses) for poses in self.touched]
        return [side * (side + 1) // 2 for side in sides]

    def check_memory(self, limit: float) -> None:
        """Refuse before the memory is spent: a SettingError when `num_bytes` is above `limit`."""
        if self.num_bytes <= limit:
            return
        need = f"{1e-9 * self.num_bytes:.2g} GB for {self.num_separators} separators"
        raise SettingError(
            f"the driver, and robots that hold fronts for it, would need {need}, more than "
            f"{1e-9 * limit:.2g} GB: they are solved for in the start, Newton and the certificate, "
            "whatever the coupling; use a METIS partition or fewer robots, raise driver_memory "
            "(--driver-memory), or set it to 0: CONSENSUS without a driver, which gives poses and "
            "no certificate"
        )

    def factorize(
        self, contributions: Sequence[Array], own: Sequence[tuple[IntArray, Array]] = ()
    ) -> InterfaceFactor:
        """Sum the robots' Schur complements and the driver's own blocks, and factor the sum.

        The contributions, (g (g + 1) / 2,) for a robot with g columns, are as `Elimination.schur`;
        the driver's own are pairs of columns (q, w) and values (q, w, w), each block on unknowns of
        one separator. A NotPositiveDefiniteError when the sum is not positive definite.
        """
        width = sum(self.widths)
        place = np.empty(self.side, dtype=np.int64)
        place[self.order] = np.arange(self.side)
        blocks = np.zeros((self.num_separators, width, width))
        for columns, values in own:
            separator, number = np.divmod(place[columns], width)
            np.add.at(
                blocks, (separator[:, :1, None], number[:, :, None], number[:, None, :]), values
            )
        name = self.fronts.new_factor()
        matrix = FrontMatrix(name.number, self.widths, self.fronts.factors_in_use)
        schur: dict[int, Array] = {}
        for level in levels(self.fronts.tree):
            parts = parts_of_fronts(self.fronts, level, contributions, schur, blocks)
            orders = {number: (matrix, of_front) for number, of_front in parts.items()}
            schur.update(self.fronts.ask(HeldFront.eliminate, orders))
        return TreeFactor(self, name)

    @cached_property
    def order(self) -> IntArray:
        """Unknowns, stacked field by field, in the order separator by separator."""
        count = self.num_separators
        fields: list[IntArray] = []
        first = 0
        for width in self.widths:
            rows = first + np.arange(width * count)
            fields.append(rows.reshape(count, width))
            first += width * count
        return np.concatenate(fields, axis=1).ravel()

    def rounding(
        self, sizes: Sequence[Array], own: Sequence[tuple[IntArray, Array]], diagonal: Array
    ) -> Array:
        """Bound by how much the factor can differ from the exact sum, as a diagonal, (side,).

        `own` are as there, `sizes`, (g,) each, the `row_sums` of the contributions in the scale of
        `diagonal`, (side,), which is at least the diagonal of the sum.
        """
        # Terms of the sum in every column: the eliminated unknowns of every front that a separator
        # is in, and one for every part that is added there.
        terms_of_separator = np.zeros(self.num_separators, dtype=np.int64)
        most_in_row = 0
        every = sum(self.widths)
        for front in self.fronts.tree:
            num_parts = len(front.robots) + len(front.children)
            terms_of_separator[front.separators] += every * len(front.eliminated) + num_parts
            most_in_row = max(most_in_row, every * len(front.separators))
        terms = np.concatenate([np.repeat(terms_of_separator, width) for width in self.widths])
        terms += len(sizes)
        sums = self._row_sums(sizes, own, diagonal)
        of_sums = gamma(float(terms.max(initial=0)) + 8.0)
        of_factor = column_error(terms.astype(float), float(most_in_row))
        error: Array = of_sums * sums + of_factor / (1.0 - of_sums) * diagonal
        return OUTWARD * error

    def _row_sums(
        self, sizes: Sequence[Array], own: Sequence[tuple[IntArray, Array]], diagonal: Array
    ) -> Array:
        """Sum the `row_sums` of all parts of the sum, (side,)."""
        sums = self.gather([size[:, None] for size in sizes])[:, 0]
        for columns, values in own:  # as `row_sums`, block by block
            root = np.sqrt(diagonal[columns])
            weighted = np.abs(values) @ (1.0 / root)[:, :, None]
            np.add.at(sums, columns, root * weighted[:, :, 0])
        return sums

    def gather(self, parts: Sequence[Array]) -> Array:
        """Sum the robots' vectors on their boundaries, (side, k)."""
        total = np.zeros((self.side, parts[0].shape[1]))
        for columns, part in zip(self.columns, parts, strict=True):
            total[columns] += part
        return total

    def scatter(self, x: Array) -> list[Array]:
        """Cut a vector of the driver into what every robot is sent, (g_a sum(widths), k) each."""
        return [x[columns] for columns in self.columns]


@dataclass(frozen=True, eq=False)
class TreeFactor:
    """A factor along the tree; every front keeps its part under the name, as long as this lives."""

    interface: Interface
    name: FactorName

    def solve(self, parts: Sequence[Array], own: Array | None = None) -> Solved:
        """Solve as `InterfaceFactor.solve`: down to the root, and back."""
        space = self.interface
        fronts = space.fronts
        k = parts[0].shape[1]
        width = sum(space.widths)
        blocks = own[space.order].reshape(-1, width, k) if own is not None else None
        reduced, energy = self._reduce(parts, blocks)
        x = np.empty((space.num_separators, width, k))
        on_parts = list(parts)
        known = reduced  # x on the boundary of fronts; that of the root is empty
        for level in reversed(levels(fronts.tree)):
            orders = {number: (self.name.number, known.pop(number)) for number in level}
            answers = fronts.ask(HeldFront.substitute, orders)
            for number, (x_E, below) in answers.items():
                front = fronts.tree[number]
                x[front.eliminated] = x_E.reshape(-1, width, k)
                num_robots = len(front.robots)
                for robot, part in zip(front.robots, below[:num_robots], strict=True):
                    on_parts[robot] = part
                known.update(zip(front.children, below[num_robots:], strict=True))
        stacked = np.empty((space.side, k))
        stacked[space.order] = x.reshape(stacked.shape)
        return stacked, on_parts, energy

    def _reduce(
        self, parts: Sequence[Array], blocks: Array | None
    ) -> tuple[dict[int, Array], float]:
        """Reduce right-hand sides front by front, to what the root leaves, and compute b^T x."""
        fronts = self.interface.fronts
        energy = 0.0
        reduced: dict[int, Array] = {}
        for level in levels(fronts.tree):
            parts_of_level = parts_of_fronts(fronts, level, parts, reduced, blocks)
            orders = {
                number: (self.name.number, of_front) for number, of_front in parts_of_level.items()
            }
            answers = fronts.ask(HeldFront.reduce, orders)
            reduced.update({number: b for number, (b, _) in answers.items()})
            energy += math.fsum(square for _, square in answers.values())
        return reduced, energy


def parts_of_fronts(
    fronts: FrontOwners,
    level: Sequence[int],
    robots: Sequence[Array],
    children: dict[int, Array],
    own: Array | None,
) -> dict[int, FrontParts]:
    """Collect what the fronts of a level are the sum of.

    The driver's part goes along where it is not zero; those of children are used up.
    """
    parts: dict[int, FrontParts] = {}
    for number in level:
        front = fronts.tree[number]
        of_robots = [robots[robot] for robot in front.robots]
        of_children = [children.pop(child) for child in front.children]
        of_driver = own[front.eliminated] if own is not None else None
        if of_driver is not None and not of_driver.any():
            of_driver = None
        parts[number] = FrontParts((*of_robots, *of_children), of_driver)
    return parts
