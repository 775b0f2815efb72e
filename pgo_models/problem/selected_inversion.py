"""Selected inversion: entries of the inverse of a sparse matrix on the pattern of its Cholesky factor.

For Z = (L L^T)^-1, J the columns of a supernode and I the rows below them (Takahashi, Fagan & Chen 1973, Z L = L^-T):

    G = L_IJ L_JJ^-1,    Z_IJ = -Z_II G,    Z_JJ = L_JJ^-T L_JJ^-1 - G^T Z_IJ.

I is among the rows of the parent in the elimination tree, whose front, Z in these rows, is known from the roots down.
"""

from functools import cache

import numpy as np
from scipy.linalg.lapack import dtrtri
from scipy.sparse import csc_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray


def selected_inverse(L: csc_array) -> Array:
    """Values of (L L^T)^-1 at the stored entries of L, in their order.

    L is as of `CholeskyFactor.take_apart`: lower triangular, rows sorted, all of its pattern stored, zeros included.
    """
    data, indices, indptr, side = L.data, L.indices, L.indptr.astype(np.int64), L.shape[0]
    count, above = np.diff(indptr), np.full(side, -1)  # of columns: their rows and their parents
    above[count > 1] = indices[indptr[:-1][count > 1] + 1]
    # A supernode is a run of columns, each of which has the rows of the next one, and that.
    is_first = np.append(True, (above[:-1] != np.arange(1, side)) | (count[:-1] != count[1:] + 1))
    first, width = np.flatnonzero(is_first), np.diff(np.append(np.flatnonzero(is_first), side))
    parents = (np.cumsum(is_first) - 1)[above[first + width - 1]]  # that of a root is not asked for
    waiting = np.bincount(parents, minlength=len(first)).tolist()
    shapes = zip(parents.tolist(), width.tolist(), count[first].tolist(), indptr[first].tolist(), strict=True)
    fronts: dict[int, tuple[IntArray, Array]] = {}  # rows and Z of supernodes that children wait for
    trapezoid = cache(lambda w, size: np.flatnonzero(np.arange(size) >= np.arange(w)[:, None]))  # what L stores of L_T
    Z = np.empty_like(data)
    for k, (parent, w, size, begin) in reversed(list(enumerate(shapes))):
        stored = trapezoid(w, size)
        mine = slice(begin, begin + len(stored))
        flat = np.zeros(w * size)
        flat[stored] = data[mine]
        L_T, rows = flat.reshape(w, size), indices[begin : begin + size]
        inverse, _ = dtrtri(L_T[:, :w])
        front = np.empty((size if waiting[k] else w, size))
        front[:w, :w] = inverse @ inverse.T
        if size > w:
            G_T = inverse @ L_T[:, w:]
            rows_above, Z_above = fronts[parent]
            place = rows_above.searchsorted(rows[w:])
            Z_II = Z_above.take(place, axis=0).take(place, axis=1)
            less = G_T @ Z_II
            front[:w, w:] = -less
            front[:w, :w] += less @ G_T.T
            if waiting[k]:
                front[w:, :w], front[w:, w:] = front[:w, w:].T, Z_II
            waiting[parent] -= 1
            if not waiting[parent]:
                del fronts[parent]
        if waiting[k]:
            fronts[k] = rows, front
        Z[mine] = front[:w].ravel().take(stored)
    return np.asarray(Z)
