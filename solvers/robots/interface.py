"""Interface problem of substructuring: the sum of Schur complements, one sparse matrix.

Robots leave the poses to the driver that would couple many others (`solvers.soc.subdomains`), and
send sparse Schur complements. The driver factors their sum in one order of elimination of all its
poses. An interface says which unknowns there are. Its factors are values: each stays as it is when
another one is computed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, tril

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray, edge_counts, middle_node
from pgo_models.problem.cholesky import (
    CholeskyBackend,
    CholeskyFactor,
    SymbolicCholesky,
    analyze,
    default_backend,
)
from pgo_models.problem.floating_point import OUTWARD, gamma
from pgo_models.problem.matrices import columns_of, inner
from pgo_models.problem.ordering import most_counts, order_of_pattern, pattern_of_edges, row_order
from solvers.robots.subdomain_blocks import Widths, coupled_unknowns, entry_keys, positions_of
from solvers.soc.subgraph import RobotSummary

Int32Array = NDArray[np.int32]
# Bytes of a stored entry of the sum: its value, twice, its key, its row, and CVXOPT's copy.
_BYTES_OF_ENTRY = 44
# Bytes of an entry of a factor. CHOLMOD stores its value. SuperLU stores L and U, each with rows,
# 12 bytes an entry, and the bound on its rounding takes up to eight more matrices of that pattern.
_BYTES_OF_FACTOR = {CholeskyBackend.CHOLMOD: 8, CholeskyBackend.SUPERLU: 120}

Solved = tuple[Array, list[Array], float]


@dataclass(frozen=True, eq=False)
class Separators:
    """The poses that the driver solves for, and which of them are coupled.

    A robot without edges touches nothing; one whose edges have no end in the cover touches no pose.
    """

    cover: IntArray  # (g,): their numbers in the whole graph, ascending
    touched: tuple[IntArray, ...]  # (g_a,) each: positions of those that a robot touches, ascending
    # (k, 2) each: as `RobotSummary.coupled`; () without a driver that solves
    coupled: tuple[IntArray, ...]
    d: int
    backend: CholeskyBackend

    @classmethod
    def of(
        cls, summaries: Sequence[RobotSummary], backend: CholeskyBackend | None = None
    ) -> Separators:
        """Separators of robots; those with edges touch some."""
        cover = np.unique(np.concatenate([robot.cover for robot in summaries]))
        touched = [robot.touched for robot in summaries if robot.touched is not None]
        coupled = [robot.coupled for robot in summaries if robot.coupled is not None]
        return cls(
            cover=cover,
            touched=tuple(np.searchsorted(cover, poses) for poses in touched),
            coupled=tuple(coupled),
            d=summaries[0].d,
            backend=backend or default_backend(),
        )

    @cached_property
    def of_robots(self) -> tuple[csr_array, ...]:
        """Lower triangles of the poses that every robot touches."""
        triangles = []
        for poses, pairs in zip(self.touched, self.coupled, strict=True):
            shape = (len(poses), len(poses))
            triangles.append(csr_array((np.ones(len(pairs)), tuple(pairs.T)), shape=shape))
        return tuple(triangles)

    @cached_property
    def lower(self) -> csc_array:
        """Lower triangle of the cover, (g, g)."""
        pairs = [poses[coupled] for poses, coupled in zip(self.touched, self.coupled, strict=True)]
        larger, smaller = np.concatenate([np.zeros((0, 2), dtype=np.int64), *pairs]).T
        return pattern_of_edges(len(self.cover), larger, smaller)

    @cached_property
    def order(self) -> IntArray:
        """Order of elimination of the poses, (g,)."""
        return order_of_pattern(self.lower, self.d)

    @cached_property
    def analysis(self) -> SymbolicCholesky:
        """Symbolic factorisation of a matrix with one entry for two poses that are coupled."""
        return analyze(_stored(self.lower, self.backend)[0], self.backend, self.order)

    @cached_property
    def num_filled(self) -> int:
        """Number of pairs of poses in the factor."""
        return int(self.analysis.counts.in_row.sum())

    @cached_property
    def middle(self) -> int:
        """Position in the cover of a pose in the middle, by the number of coupled pairs between.

        Bounds are proved with that pose left out: the smallest eigenvalue of what remains is much
        smaller where a pose at the rim is.
        """
        rows, columns = self.lower.tocoo().coords
        return middle_node(edge_counts(rows, columns, len(self.cover)))


def _stored(lower: csc_array, backend: CholeskyBackend) -> tuple[csc_array, IntArray | slice]:
    """Pattern that the library wants of a lower triangle, and which entry each of its entries is.

    CHOLMOD reads the lower triangle; SuperLU needs the symmetric matrix.
    """
    if backend is CholeskyBackend.CHOLMOD:
        return lower, slice(None)
    numbers = np.arange(1, lower.nnz + 1)
    numbered = csc_array((numbers, lower.indices, lower.indptr), shape=lower.shape)
    symmetric = csc_array(numbered + tril(numbered, -1).T)
    symmetric.sort_indices()
    entries = symmetric.data - 1
    return csc_array(
        (np.ones(symmetric.nnz), symmetric.indices, symmetric.indptr), symmetric.shape
    ), entries


@dataclass(frozen=True, eq=False)
class UnknownsPattern:
    """The pattern of the unknowns, and its analysis."""

    lower: csc_array
    robots: tuple[Int32Array, ...]  # positions of every robot's entries among those of `lower`
    stored: csc_array  # what is factored, and which entry of `lower` each of its entries is
    entries: IntArray | slice
    analysis: SymbolicCholesky


@dataclass(frozen=True, eq=False)
class Interface:
    """The matrix of the sum, for one kind of unknowns."""

    separators: Separators
    widths: Widths  # numbers per separator in every field; fields are stacked

    @property
    def side(self) -> int:
        """Number of unknowns."""
        return sum(self.widths) * len(self.separators.cover)

    @cached_property
    def columns(self) -> tuple[IntArray, ...]:
        """Columns of every robot's boundary, each (g_a sum(widths),)."""
        num_separators = len(self.separators.cover)
        return tuple(
            columns_of(poses, num_separators, self.widths) for poses in self.separators.touched
        )

    @property
    def num_bytes(self) -> int:
        """Memory for contributions, their sum and the factor, known before it is spent."""
        width = sum(self.widths)
        separators = self.separators
        summed = _BYTES_OF_ENTRY * width**2 * separators.lower.nnz
        factor = _BYTES_OF_FACTOR[separators.backend] * width**2 * separators.num_filled
        # What robots send, and where it is added.
        return summed + factor + 12 * sum(self.num_entries)

    @property
    def num_entries(self) -> list[int]:
        """Numbers that every robot sends of its Schur complement."""
        width = sum(self.widths)
        lower = width * (width + 1) // 2
        return [
            width**2 * (robot.nnz - robot.shape[0]) + lower * robot.shape[0]
            for robot in self.separators.of_robots
        ]

    def check_memory(self, limit: float) -> None:
        """Refuse before the memory is spent: a SettingError when `num_bytes` is above `limit`."""
        if self.num_bytes <= limit:
            return
        num_separators = len(self.separators.cover)
        need = f"{1e-9 * self.num_bytes:.2g} GB for {num_separators} separators"
        raise SettingError(
            f"the driver would need {need}, more than "
            f"{1e-9 * limit:.2g} GB: they are solved for in the start, Newton and the certificate, "
            "whatever the coupling; use a METIS partition or fewer robots, raise driver_memory "
            "(--driver-memory), or set it to 0: CONSENSUS without a driver, which gives poses and "
            "no certificate"
        )

    @cached_property
    def unknowns(self) -> UnknownsPattern:
        """The pattern of the unknowns, analysed when it is first needed."""
        separators = self.separators
        lower = csc_array(coupled_unknowns(csr_array(separators.lower), self.widths))
        order = row_order(separators.order, *self.widths)
        most = partial(most_counts, separators.analysis, *self.widths)
        stored, entries = _stored(lower, separators.backend)
        analysis = analyze(stored, separators.backend, order, most)
        keys = _keys(lower)
        positions = []
        for columns, coupled in zip(self.columns, separators.of_robots, strict=True):
            of_robot = coupled_unknowns(coupled, self.widths).tocoo()
            keys_of_robot = entry_keys(columns[of_robot.col], columns[of_robot.row], self.side)
            positions.append(positions_of(keys_of_robot, keys).astype(np.int32))
        return UnknownsPattern(lower, tuple(positions), stored, entries, analysis)

    def factorize(
        self, contributions: Sequence[Array], of_driver: Sequence[tuple[IntArray, Array]] = ()
    ) -> InterfaceFactor:
        """Sum the robots' Schur complements and the driver's own blocks, and factor the sum.

        The contributions are as `Elimination.schur`; the driver's own are pairs of columns (q, w)
        and values (q, w, w), each block on unknowns of one separator. A NotPositiveDefiniteError
        when the sum is not positive definite.
        """
        unknowns = self.unknowns
        values = np.zeros(unknowns.lower.nnz)
        keys = _keys(unknowns.lower)
        for positions, part in zip(unknowns.robots, contributions, strict=True):
            values[positions] += part
        for columns, blocks in of_driver:
            row = np.broadcast_to(columns[:, :, None], blocks.shape)
            column = np.broadcast_to(columns[:, None, :], blocks.shape)
            is_lower = row >= column
            of_blocks = entry_keys(column[is_lower], row[is_lower], self.side)
            np.add.at(values, positions_of(of_blocks, keys), blocks[is_lower])
        del keys
        stored = unknowns.stored
        matrix = csc_array(
            (values[unknowns.entries], stored.indices, stored.indptr), shape=stored.shape
        )
        return InterfaceFactor(self, unknowns.analysis.factorize(matrix))

    def rounding(
        self,
        sizes: Sequence[Array],
        of_driver: Sequence[tuple[IntArray, Array]],
        diagonal: Array,
        of_factor: Array,
    ) -> Array:
        """Bound by how much the factor can differ from the exact sum, as a diagonal, (side,).

        `of_driver` are the blocks of `factorize`. `sizes`, (g,) each, are the `row_sums` of the
        contributions in the scale of `diagonal`, (side,), which is at least the diagonal of the
        sum. `of_factor`, (side,), is the `expected_error` of the analysis, or the `backward_error`
        of the factor. An entry of the sum has a term of every robot, and of the driver's blocks.
        """
        of_sums = gamma(float(len(sizes) + len(of_driver)) + 8.0)
        sums = self.gather([size[:, None] for size in sizes])[:, 0]
        for columns, values in of_driver:  # as `row_sums`, block by block
            root = np.sqrt(diagonal[columns])
            weighted = np.abs(values) @ (1.0 / root)[:, :, None]
            np.add.at(sums, columns, root * weighted[:, :, 0])
        error: Array = of_sums * sums + of_factor / (1.0 - of_sums) * diagonal
        return OUTWARD * error

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
class InterfaceFactor:
    """A factor of the sum of the robots' Schur complements and the driver's own blocks."""

    interface: Interface
    factor: CholeskyFactor

    def solve(self, parts: Sequence[Array], of_driver: Array | None = None) -> Solved:
        """Solve for the sum of the robots' right-hand sides and that `of_driver`, (side, k).

        The answer is x, (side, k), x on every robot's boundary, and b^T x.
        """
        b = self.interface.gather(parts)
        if of_driver is not None:
            b += of_driver
        x = self.factor.solve(b) if b.size else b
        return x, self.interface.scatter(x), inner(b, x)


def _keys(lower: csc_array) -> IntArray:
    """Return the `entry_keys` of the entries of a pattern, column by column, ascending."""
    side = lower.shape[1]
    columns = np.repeat(np.arange(side), np.diff(lower.indptr))
    return entry_keys(columns, lower.indices, side)
