"""The interface as one sparse matrix, which the driver factors, where robots interleave.

Fronts of groups of robots (`solvers.distributed.multifrontal`) are small where every group covers
an area of its own. Where the areas of robots interleave, most separators are eliminated at the
root. There the robots leave more poses to the driver and send sparse Schur complements
(`solvers.soc.subdomains`), and the driver factors their sum in an order of minimum degree of all
its poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import (
    CholeskyBackend,
    CholeskyFactor,
    SymbolicCholesky,
    analyze,
)
from pgo_models.problem.floating_point import OUTWARD, gamma
from pgo_models.problem.matrices import inner
from pgo_models.problem.ordering import (
    most_counts,
    order_of_pattern,
    pattern_of_edges,
    row_order,
)
from solvers.distributed.interface import Interface, Solved
from solvers.distributed.robots.subdomain_blocks import coupled_unknowns, entry_keys, positions_of

Int32Array = NDArray[np.int32]
# Bytes of a stored entry of the sum: its value, twice, its key, its row, and CVXOPT's copy.
_BYTES_OF_ENTRY = 44


@dataclass(frozen=True, eq=False)
class CoverPattern:
    """Which poses of the cover are coupled, in an order that keeps the factor sparse."""

    robots: tuple[csr_array, ...]  # lower triangles of the poses that every robot touches
    lower: csc_array  # (g, g): of the cover
    d: int

    @classmethod
    def of(
        cls, touched: Sequence[IntArray], coupled: Sequence[IntArray], num_separators: int, d: int
    ) -> CoverPattern:
        """Pattern of pairs (k, 2) of positions in the `touched` poses of every robot."""
        robots = []
        rows = []
        columns = []
        for poses, pairs in zip(touched, coupled, strict=True):
            larger, smaller = pairs.T
            shape = (len(poses), len(poses))
            robots.append(csr_array((np.ones(len(pairs)), (larger, smaller)), shape=shape))
            rows.append(poses[larger])
            columns.append(poses[smaller])
        lower = pattern_of_edges(num_separators, np.concatenate(rows), np.concatenate(columns))
        return cls(tuple(robots), lower, d)

    @cached_property
    def order(self) -> IntArray:
        """Order of elimination of the poses, (g,)."""
        return order_of_pattern(self.lower, self.d)

    @cached_property
    def analysis(self) -> SymbolicCholesky:
        """Symbolic factorisation of a matrix with one entry for two poses that are coupled."""
        return analyze(self.lower, CholeskyBackend.CHOLMOD, self.order)

    @cached_property
    def counts(self) -> IntArray:
        """Poses in every column of the factor, (g,)."""
        return self.analysis.counts.in_row.astype(np.int64)

    def flops(self, width: int) -> float:
        """Operations of a factorisation with so many unknowns per pose."""
        return float(np.sum((width * self.counts.astype(float)) ** 2) * width)


@dataclass(frozen=True, eq=False)
class UnknownsPattern:
    """The pattern of the unknowns, and its analysis."""

    lower: csc_array
    robots: tuple[Int32Array, ...]  # positions of every robot's entries among those of `lower`
    analysis: SymbolicCholesky


@dataclass(frozen=True, eq=False)
class SparseInterface(Interface):
    """The matrix of the sum, sparse, for one kind of unknowns; its tree has no fronts."""

    pattern: CoverPattern = field(kw_only=True)

    @property
    def num_bytes(self) -> int:
        """Memory for contributions, their sum and the factor, known before it is spent."""
        width = sum(self.widths)
        summed = _BYTES_OF_ENTRY * width**2 * self.pattern.lower.nnz
        factor = 8 * width**2 * int(self.pattern.counts.sum())
        # What robots send, and where it is added.
        return summed + factor + 12 * sum(self.num_entries)

    @property
    def num_entries(self) -> list[int]:
        """Numbers that every robot sends of its Schur complement."""
        width = sum(self.widths)
        lower = width * (width + 1) // 2
        return [
            width**2 * (robot.nnz - robot.shape[0]) + lower * robot.shape[0]
            for robot in self.pattern.robots
        ]

    @cached_property
    def unknowns(self) -> UnknownsPattern:
        """The pattern of the unknowns, analysed when it is first needed."""
        side = self.side
        lower = csc_array(coupled_unknowns(csr_array(self.pattern.lower), self.widths))
        order = row_order(self.pattern.order, *self.widths)
        most = partial(most_counts, self.pattern.analysis, *self.widths)
        analysis = analyze(lower, CholeskyBackend.CHOLMOD, order, most)
        keys = _keys(lower)
        positions = []
        for columns, coupled in zip(self.columns, self.pattern.robots, strict=True):
            entries = coupled_unknowns(coupled, self.widths).tocoo()
            of_robot = entry_keys(columns[entries.col], columns[entries.row], side)
            positions.append(positions_of(of_robot, keys).astype(np.int32))
        return UnknownsPattern(lower, tuple(positions), analysis)

    def factorize(
        self, contributions: Sequence[Array], own: Sequence[tuple[IntArray, Array]] = ()
    ) -> SparseFactor:
        """Sum the contributions and the driver's own blocks, as `Interface.factorize`.

        The contributions are the entries that the blocks of a robot's cut store.
        """
        unknowns = self.unknowns
        values = np.zeros(unknowns.lower.nnz)
        keys = _keys(unknowns.lower)
        for positions, part in zip(unknowns.robots, contributions, strict=True):
            values[positions] += part
        for columns, blocks in own:
            row = np.broadcast_to(columns[:, :, None], blocks.shape)
            column = np.broadcast_to(columns[:, None, :], blocks.shape)
            is_lower = row >= column
            of_blocks = entry_keys(column[is_lower], row[is_lower], self.side)
            np.add.at(values, positions_of(of_blocks, keys), blocks[is_lower])
        del keys
        lower = unknowns.lower
        matrix = csc_array((values, lower.indices, lower.indptr), lower.shape)
        return SparseFactor(self, unknowns.analysis.factorize(matrix))

    def rounding(
        self, sizes: Sequence[Array], own: Sequence[tuple[IntArray, Array]], diagonal: Array
    ) -> Array:
        """Bound by how much the factor can differ from the exact sum, as `Interface.rounding`.

        An entry of the sum has a term of every robot, and of the driver's own blocks.
        """
        num_terms = float(len(sizes) + len(own))
        of_sums = gamma(num_terms + 8.0)
        of_factor = self.unknowns.analysis.expected_error()
        sums = self._row_sums(sizes, own, diagonal)
        error: Array = of_sums * sums + of_factor / (1.0 - of_sums) * diagonal
        return OUTWARD * error


@dataclass(frozen=True, eq=False)
class SparseFactor:
    """A factor of the sum of one sparse interface."""

    interface: SparseInterface
    factor: CholeskyFactor

    def solve(self, parts: Sequence[Array], own: Array | None = None) -> Solved:
        """Solve as `InterfaceFactor.solve`."""
        b = self.interface.gather(parts)
        if own is not None:
            b += own
        if not b.size:
            return b, self.interface.scatter(b), 0.0
        x = self.factor.solve(b)
        return x, self.interface.scatter(x), inner(b, x)


def _keys(lower: csc_array) -> IntArray:
    """Return the `entry_keys` of the entries of a pattern, column by column, ascending."""
    side = lower.shape[1]
    columns = np.repeat(np.arange(side), np.diff(lower.indptr))
    return entry_keys(columns, lower.indices, side)
