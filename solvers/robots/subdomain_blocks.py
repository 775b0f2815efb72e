"""Blocks of a sparse Schur complement: where every subdomain of a robot adds to it.

Rows and columns are the unknowns of the boundary, stacked field by field. Only the lower triangle
is stored, row by row; driver and robot derive its pattern from the same pairs of poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import block_array, csr_array, kron

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from solvers.soc.subdomains import Subdomains

Widths = tuple[int, ...]  # numbers a separator in every field


def coupled_unknowns(coupled: csr_array, widths: Widths) -> csr_array:
    """Lower triangle of the unknowns that are coupled, of that of the poses, (g, g)."""
    g = coupled.shape[0]
    side = g * sum(widths)
    if not g:
        return csr_array((0, 0))
    of_pose = []
    begin = 0
    for width in widths:
        of_pose.append(begin + width * np.arange(g)[:, None] + np.arange(width))
        begin += width * g
    unknowns = np.concatenate(of_pose, axis=1)  # (g, sum(widths)): of every pose
    rows, columns = coupled.tocoo().coords
    row_unknowns = unknowns[rows][:, :, None]
    column_unknowns = unknowns[columns][:, None, :]
    ends = (
        np.maximum(row_unknowns, column_unknowns).ravel(),
        np.minimum(row_unknowns, column_unknowns).ravel(),
    )
    lower = csr_array((np.ones(len(ends[0])), ends), shape=(side, side))
    lower.sum_duplicates()  # two unknowns of one pose come twice; sorted, too
    return lower.astype(bool)


@dataclass(frozen=True, eq=False)
class Products:
    """Sums of Z^T Z over the subdomains, and what bounds their rounding."""

    lower: Array  # (k,): as the entries of the pattern
    nonzeros_in_column: Array  # (g,): of Z
    squares: Array  # (g,): of the columns of Z


@dataclass(frozen=True, eq=False)
class SubdomainBlocks:
    """Pattern of a Schur complement with g rows and k entries, and its blocks.

    The columns of a subdomain are the unknowns of the poses that it reaches.
    """

    subdomains: Subdomains
    widths: Widths

    @cached_property
    def pattern(self) -> csr_array:
        """Lower triangle, (g, g)."""
        return coupled_unknowns(self.subdomains.coupled, self.widths)

    @cached_property
    def label(self) -> IntArray:
        """Subdomain of every unknown of the interior, (i,)."""
        label = self.subdomains.label
        return np.concatenate([np.repeat(label, width) for width in self.widths])

    @cached_property
    def reached(self) -> csr_array:
        """Entries where a subdomain reaches an unknown of the boundary, (s, g)."""
        of_poses = self.subdomains.reached
        of_fields = [kron(of_poses, np.ones((1, width))) for width in self.widths]
        if not of_poses.nnz:
            return csr_array((of_poses.shape[0], sum(self.widths) * of_poses.shape[1]))
        reached = csr_array(block_array([of_fields]))
        reached.sort_indices()
        return reached

    @property
    def side(self) -> int:
        """Number of unknowns of the boundary, g."""
        return int(self.pattern.shape[0])

    @property
    def diagonal(self) -> IntArray:
        """Positions of the diagonal among the entries, (g,): the last one of every row."""
        return self.pattern.indptr[1:] - 1

    def lower_entries(self, matrix: csr_array) -> Array:
        """Entries of the lower triangle of a matrix (g, g), all of which the pattern has, (k,)."""
        entries = matrix.tocoo()
        is_lower = entries.row >= entries.col
        positions = self._positions(entries.row[is_lower], entries.col[is_lower])
        values = np.zeros(self.pattern.nnz)
        values[positions] = entries.data[is_lower]
        return values

    def symmetric(self, values: Array) -> csr_array:
        """Return the symmetric matrix with these entries in its lower triangle."""
        lower = csr_array(
            (values, self.pattern.indices, self.pattern.indptr), shape=self.pattern.shape
        )
        below = lower.copy()
        below.data[self.diagonal] = 0.0
        return csr_array(lower + below.T)

    def compressed(self, K_IG: csr_array) -> Array:
        """K_IG, (i, g), with the columns of every subdomain moved to the front."""
        pointers = self.reached.indptr
        num_columns = np.diff(pointers)
        entries = K_IG.tocoo()
        subdomain = self.label[entries.row]
        of_columns = np.repeat(np.arange(len(num_columns)), num_columns)
        places = positions_of(
            entry_keys(subdomain, entries.col, self.side),
            entry_keys(of_columns, self.reached.indices, self.side),
        )
        compressed = np.zeros((K_IG.shape[0], int(num_columns.max(initial=0))))
        compressed[entries.row, places - pointers[subdomain]] = entries.data
        return compressed

    def products(self, Z: Array, row_order: IntArray) -> Products:
        """Sum Z^T Z over the subdomains, from Z, (i, .), with compressed columns.

        The rows of Z are in the order of elimination, `row_order`.
        """
        label = self.label[row_order]
        by_subdomain = np.argsort(label, kind="stable")
        ends = np.searchsorted(label[by_subdomain], np.arange(len(self.reached.indptr)))
        lower = np.zeros(self.pattern.nnz)
        nonzeros_in_column = np.zeros(self.side)
        squares = np.zeros(self.side)
        for subdomain, (columns, positions) in enumerate(self._blocks):
            rows = by_subdomain[ends[subdomain] : ends[subdomain + 1]]
            block = Z[rows, : len(columns)]
            product = block.T @ block
            lower[positions] += product[np.tri(len(columns), dtype=bool)]
            nonzeros_in_column[columns] += np.count_nonzero(block, axis=0)
            squares[columns] += np.einsum("ig,ig->g", block, block)
        return Products(lower, nonzeros_in_column, squares)

    @cached_property
    def _blocks(self) -> list[tuple[IntArray, IntArray]]:
        """Columns of every subdomain, and the positions of its lower triangle."""
        blocks: list[tuple[IntArray, IntArray]] = []
        reached = self.reached.indices.astype(np.int64)
        for columns in np.split(reached, self.reached.indptr[1:-1]):
            row, column = np.tril_indices(len(columns))
            blocks.append((columns, self._positions(columns[row], columns[column])))
        return blocks

    def _positions(self, rows: IntArray, columns: IntArray) -> IntArray:
        """Positions of entries of the pattern."""
        return positions_of(entry_keys(rows, columns, self.side), self._keys)

    @cached_property
    def _keys(self) -> IntArray:
        """A number for every entry of the pattern, ascending."""
        rows = np.repeat(np.arange(self.side), np.diff(self.pattern.indptr))
        return entry_keys(rows, self.pattern.indices, self.side)


def entry_keys(rows: IntArray, columns: IntArray, side: int) -> IntArray:
    """One number for every entry of a matrix with so many columns, ascending row by row."""
    return rows.astype(np.int64) * side + columns


def positions_of(keys: IntArray, stored: IntArray) -> IntArray:
    """Positions of keys among those of the entries that are stored, ascending.

    A ValueError for an entry that is not stored: it must not be added to another one.
    """
    positions = np.searchsorted(stored, keys)
    is_stored = positions < len(stored)
    is_stored[is_stored] = stored[positions[is_stored]] == keys[is_stored]
    if not is_stored.all():
        raise ValueError("the matrix has an entry that its pattern does not have")
    return positions
