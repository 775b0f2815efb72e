"""Incidence of edges and poses: sums over the edges of a pose; arrays with a block an edge."""

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
from scipy.sparse import csc_array

from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph


@dataclass(frozen=True, eq=False)
class Incidence:
    """Which edges begin and which end at a pose."""

    begins: csc_array  # (n, m): one where edge e begins at the pose, i_e
    ends: csc_array  # (n, m): one where it ends at the pose, j_e
    i: IntArray  # (m,)
    j: IntArray  # (m,)

    @classmethod
    def of(cls, graph: PoseGraph) -> "Incidence":
        """Incidence of a graph."""
        return cls.of_pairs(graph.num_poses, graph.i, graph.j)

    @classmethod
    def of_pairs(cls, num_poses: int, i: IntArray, j: IntArray) -> "Incidence":
        """Incidence of pairs of poses, each taken for an edge from i to j."""
        m = len(i)
        shape = (num_poses, m)
        column_starts = np.arange(m + 1)
        begins = csc_array((np.ones(m), i, column_starts), shape=shape)
        ends = csc_array((np.ones(m), j, column_starts), shape=shape)
        return cls(begins, ends, i, j)

    def at_beginning(self, blocks: Array) -> Array:
        """Sums of blocks (m, a, b) over the edges that begin at a pose, (n a, b)."""
        m, _, width = blocks.shape
        sums = self.begins @ blocks.reshape(m, -1)
        return np.asarray(sums.reshape(-1, width))

    def at_both(self, of_i: Array, of_j: Array) -> Array:
        """Sums of `of_i` over the edges that begin at a pose and `of_j` over those that end at it.

        The blocks of the edges have shape (m, a, b), the sums (n, a, b).
        """
        m = len(of_i)
        block_shape = of_i.shape[1:]
        beginning = self.begins @ of_i.reshape(m, -1)
        ending = self.ends @ of_j.reshape(m, -1)
        sums = beginning + ending
        return np.asarray(sums.reshape(-1, *block_shape))


@dataclass(frozen=True, eq=False)
class EdgeArrays:
    """Base of what is made of arrays (m, ..) with an entry an edge, and of such things."""

    def of_edges(self, chosen: IntArray | BoolArray) -> Self:
        """The same of the chosen edges: these entries of every array."""
        of_chosen: dict[str, Array | EdgeArrays] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                of_chosen[field.name] = value[chosen]
            elif isinstance(value, EdgeArrays):
                of_chosen[field.name] = value.of_edges(chosen)
        return replace(self, **of_chosen)


def blocks_of_rows(rows: Array, d: int) -> Array:
    """Rows of A, ((d + 1) m, k), as blocks of edges, (m, d + 1, k): translation, then rotation."""
    m = len(rows) // (d + 1)
    translation_rows = rows[:m, None]
    rotation_rows = rows[m:].reshape(m, d, rows.shape[1])
    return np.concatenate([translation_rows, rotation_rows], axis=1)


def rows_of_blocks(blocks: Array) -> Array:
    """Rows of A, ((d + 1) m, k), of blocks of edges, (m, d + 1, k)."""
    num_columns = blocks.shape[2]
    rotation_rows = blocks[:, 1:].reshape(-1, num_columns)
    return np.concatenate([blocks[:, 0], rotation_rows])
