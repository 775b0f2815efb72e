"""Interface problem of substructuring: the driver's sum of Schur complements, factored along a tree of separators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.floating_point import OUTWARD, column_error, gamma
from pgo_models.problem.matrices import columns_of
from solvers.distributed.multifrontal import Front, TreeFactor, factorize_tree, tree_bytes, tree_counts
from solvers.distributed.robots.elimination import row_sums, unpacked


@dataclass(frozen=True, eq=False)
class Interface:
    """The driver's matrix for one kind of unknowns: how they are stacked, and who touches which separators."""

    num_separators: int
    widths: tuple[int, ...]  # numbers a separator in every field
    touched: tuple[IntArray, ...]  # (g_a,) each: separators that every robot touches, ascending
    tree: tuple[Front, ...]

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
        width = sum(self.widths)
        sides = [width * len(poses) for poses in self.touched]
        contributions = sum(side * (side + 1) // 2 for side in sides)
        own = self.side * (width + 4)  # blocks of the driver, and orders of the unknowns
        return 8 * (contributions + own) + tree_bytes(self.tree, width)

    def check_memory(self, limit: float) -> None:
        """Refuse before the memory is spent: a SettingError when `num_bytes` is above `limit`."""
        if self.num_bytes > limit:
            raise SettingError(
                f"the driver would need {1e-9 * self.num_bytes:.1f} GB for {self.num_separators} separators, more than "
                f"{1e-9 * limit:.1f} GB: it solves for them in the start, Newton and the certificate, whatever the "
                "coupling; use a METIS partition or fewer robots, raise driver_memory (--driver-memory), or set it to "
                "0: CONSENSUS without a driver, which gives poses and no certificate"
            )

    def factorize(self, contributions: Sequence[Array], own: Sequence[tuple[IntArray, Array]] = ()) -> InterfaceFactor:
        """Sum the robots' Schur complements and the driver's own blocks, and factor: `factorize_tree`.

        The contributions, (g (g + 1) / 2,) for a robot with g columns, are as `Elimination.schur`; the driver's own are
        pairs of columns (q, w) and values (q, w, w), each block on unknowns of one separator.
        """
        width = sum(self.widths)
        order = by_separator(self.num_separators, self.widths)
        place = np.empty(self.side, dtype=np.int64)
        place[order] = np.arange(self.side)
        blocks = np.zeros((self.num_separators, width, width))
        for columns, values in own:
            separator, number = np.divmod(place[columns], width)
            np.add.at(blocks, (separator[:, :1, None], number[:, :, None], number[:, None, :]), values)

        def contribution(robot: int) -> Array:
            inner_order = by_separator(len(self.touched[robot]), self.widths)
            return unpacked(contributions[robot], len(inner_order))[np.ix_(inner_order, inner_order)]

        return InterfaceFactor(factorize_tree(self.tree, width, contribution, blocks), order)

    def rounding(self, contributions: Sequence[Array], own: Sequence[tuple[IntArray, Array]], diagonal: Array) -> Array:
        """Diagonal, (side,), that bounds what the factor of `factorize` can differ from the exact sum by.

        `contributions` and `own` are as there; `diagonal`, (side,), is at least the diagonal of the sum.
        """
        in_column, most = tree_counts(self.tree, sum(self.widths), self.num_separators)
        terms = np.concatenate([np.repeat(in_column, width) for width in self.widths]) + len(contributions)
        sums = np.zeros(self.side)
        for columns, packed_lower in zip(self.columns, contributions, strict=True):
            sums[columns] += row_sums(unpacked(packed_lower, len(columns)), diagonal[columns])
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


@dataclass(frozen=True, eq=False)
class InterfaceFactor:
    """Factor of the driver's matrix; `order` lists its unknowns separator by separator."""

    factor: TreeFactor
    order: IntArray

    def solve(self, b: Array) -> Array:
        """Solution x_G, (side, k)."""
        x = np.empty_like(b)
        x[self.order] = self.factor.solve(b[self.order])
        return x


def by_separator(count: int, widths: tuple[int, ...]) -> IntArray:
    """Unknowns of `count` separators, stacked field by field, in the order separator by separator."""
    fields, first = [], 0
    for width in widths:
        fields.append(first + width * np.arange(count)[:, None] + np.arange(width))
        first += width * count
    return np.concatenate(fields, axis=1).ravel()
