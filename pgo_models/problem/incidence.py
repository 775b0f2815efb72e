"""Arrays of edges against arrays of poses: residual rows as blocks, sums over the edges of a pose."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray, PoseGraph


@dataclass(frozen=True, eq=False)
class Incidence:
    """Which edges begin and which end at a pose: sparse matrices of ones, (n, m); and these poses, (m,)."""

    begins: csc_array
    ends: csc_array
    i: IntArray
    j: IntArray

    @classmethod
    def of(cls, graph: PoseGraph) -> "Incidence":
        """Incidence of a graph."""
        n, m, i, j = graph.num_poses, graph.num_edges, graph.i, graph.j
        begins, ends = (csc_array((np.ones(m), pose, np.arange(m + 1)), shape=(n, m)) for pose in (i, j))
        return cls(begins, ends, i, j)

    def at_beginning(self, blocks: Array) -> Array:
        """Sums of blocks (m, a, b) over the edges that begin at a pose, (n a, b)."""
        return np.asarray((self.begins @ blocks.reshape(len(blocks), -1)).reshape(-1, blocks.shape[2]))

    def at_both(self, of_i: Array, of_j: Array) -> Array:
        """Sums of blocks (m, a, b) over the edges that begin, and that end, at a pose, (n, a, b)."""
        found = self.begins @ of_i.reshape(len(of_i), -1) + self.ends @ of_j.reshape(len(of_j), -1)
        return np.asarray(found.reshape(-1, *of_i.shape[1:]))


def blocks_of_rows(rows: Array, m: int, axes: Array | None = None) -> Array:
    """Rows of A, ((d + 1) m, k), as blocks of edges, (m, d + 1, k): translation, then rotation off its axes."""
    turning = rows[m:].reshape(m, -1, rows.shape[1])
    return np.concatenate([rows[:m, None], turning if axes is None else axes @ turning], axis=1)


def rows_of_blocks(blocks: Array, axes: Array | None = None) -> Array:
    """Rows of A, ((d + 1) m, k), of blocks of edges, (m, d + 1, k), along the axes of its rotation rows."""
    turning = blocks[:, 1:] if axes is None else np.swapaxes(axes, 1, 2) @ blocks[:, 1:]
    return np.concatenate([blocks[:, 0], turning.reshape(-1, blocks.shape[2])])
