"""Arrays of edges against arrays of poses.

Residual rows become blocks of edges, and blocks are summed over the edges of a pose.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray, PoseGraph


@dataclass(frozen=True, eq=False)
class Incidence:
    """Which edges begin and which end at a pose.

    These are sparse matrices of ones, (n, m), and the poses, (m,).
    """

    begins: csc_array
    ends: csc_array
    i: IntArray
    j: IntArray

    @classmethod
    def of(cls, graph: PoseGraph) -> "Incidence":
        """Incidence of a graph."""
        n = graph.num_poses
        m = graph.num_edges
        i = graph.i
        j = graph.j
        begins, ends = (
            csc_array((np.ones(m), pose, np.arange(m + 1)), shape=(n, m)) for pose in (i, j)
        )
        return cls(begins, ends, i, j)

    def at_beginning(self, blocks: Array) -> Array:
        """Sums of blocks (m, a, b) over the edges that begin at a pose, (n a, b)."""
        return np.asarray(
            (self.begins @ blocks.reshape(len(blocks), -1)).reshape(-1, blocks.shape[2])
        )

    def at_both(self, of_i: Array, of_j: Array) -> Array:
        """Sums of blocks over the edges that begin, and those that end, at a pose, (n, a, b).

        The blocks have shape (m, a, b).
        """
        beginning = self.begins @ of_i.reshape(len(of_i), -1)
        ending = self.ends @ of_j.reshape(len(of_j), -1)
        return np.asarray((beginning + ending).reshape(-1, *of_i.shape[1:]))


def blocks_of_rows(rows: Array, m: int) -> Array:
    """Rows of A, ((d + 1) m, k), as blocks of edges, (m, d + 1, k): translation, then rotation."""
    return np.concatenate([rows[:m, None], rows[m:].reshape(m, -1, rows.shape[1])], axis=1)


def rows_of_blocks(blocks: Array) -> Array:
    """Rows of A, ((d + 1) m, k), of blocks of edges, (m, d + 1, k)."""
    return np.concatenate([blocks[:, 0], blocks[:, 1:].reshape(-1, blocks.shape[2])])
