"""Arrays of edges against arrays of poses: residual rows as blocks, sums over the edges of a pose, block Laplacians."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.matrices import assemble, block_entries, incidence_matrices, rotation_columns


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
        return cls(*incidence_matrices(graph), graph.i, graph.j)

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


def block_laplacian(incidence: Incidence, of_edges: Array) -> csc_array:
    """Laplacian with weights (m, d, d), the matrix of translations with such information; grounded at pose 0."""
    own, d = incidence.at_both(of_edges, of_edges), of_edges.shape[1]
    own[0] *= 2.0
    t_i, t_j, t = (rotation_columns(k, 0, d) for k in (incidence.i, incidence.j, np.arange(len(own))))
    signed = ((t, t, own), (t_i, t_j, -of_edges), (t_j, t_i, -of_edges))
    blocks = [(*block_entries(rows, columns), values) for rows, columns, values in signed]
    return assemble(blocks, d * len(own))
