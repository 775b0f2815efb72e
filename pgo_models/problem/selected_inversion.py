"""Selected inversion: entries of the inverse on the pattern of a sparse Cholesky factor.

For Z = (L L^T)^-1, J the columns of a supernode and I the rows below them (Takahashi, Fagan & Chen
1973, Z L = L^-T):

    G = L_IJ L_JJ^-1,    Z_IJ = -Z_II G,    Z_JJ = L_JJ^-T L_JJ^-1 - G^T Z_IJ.

I is among the rows of the parent in the elimination tree, whose front, Z in these rows, is known
from the roots down.
"""

from functools import cache

import numpy as np
from scipy.linalg.lapack import dtrtri
from scipy.sparse import csc_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray


def selected_inverse(L: csc_array) -> Array:
    """Values of (L L^T)^-1 at the stored entries of L, in their order.

    L is as of `CholeskyFactor.take_apart`: lower triangular, rows sorted, all of its pattern
    stored, zeros included.
    """
    data = L.data
    indices = L.indices
    shapes = _supernodes(L)
    # how many children of every supernode still ask for its front; that of a root is not asked for
    waiting = np.bincount([parent for parent, *_ in shapes], minlength=len(shapes)).tolist()
    # rows and Z of supernodes that children wait for
    fronts: dict[int, tuple[IntArray, Array]] = {}
    # what L stores of L_T
    trapezoid = cache(lambda w, size: np.flatnonzero(np.arange(size) >= np.arange(w)[:, None]))
    Z = np.empty_like(data)
    for k, (parent, w, size, begin) in reversed(list(enumerate(shapes))):
        stored = trapezoid(w, size)
        mine = slice(begin, begin + len(stored))
        flat = np.zeros(w * size)
        flat[stored] = data[mine]
        L_T = flat.reshape(w, size)
        rows = indices[begin : begin + size]
        inverse, _ = dtrtri(L_T[:, :w])
        front = np.empty((size if waiting[k] else w, size))
        front[:w, :w] = inverse @ inverse.T
        if size > w:
            G_T = inverse @ L_T[:, w:]
            rows_above, Z_above = fronts[parent]
            place = rows_above.searchsorted(rows[w:])
            Z_II = Z_above.take(place, axis=0).take(place, axis=1)
            product = G_T @ Z_II
            front[:w, w:] = -product
            front[:w, :w] += product @ G_T.T
            if waiting[k]:
                front[w:, :w] = front[:w, w:].T
                front[w:, w:] = Z_II
            waiting[parent] -= 1
            if not waiting[parent]:
                del fronts[parent]
        if waiting[k]:
            fronts[k] = rows, front
        Z[mine] = front[:w].ravel().take(stored)
    return np.asarray(Z)


def _supernodes(L: csc_array) -> list[tuple[int, int, int, int]]:
    """Parent, width, rows of the first column, and its place in `L.data`, of every supernode.

    A supernode is a run of columns, each of which has the rows of the next one, and that. The
    parent of a root means nothing.
    """
    indptr = L.indptr.astype(np.int64)
    side = L.shape[0]
    count = np.diff(indptr)
    above = np.full(side, -1)  # the parent of a column: the row of its first entry off the diagonal
    above[count > 1] = L.indices[indptr[:-1][count > 1] + 1]
    is_first = np.append(True, (above[:-1] != np.arange(1, side)) | (count[:-1] != count[1:] + 1))
    first = np.flatnonzero(is_first)
    width = np.diff(np.append(first, side))
    parents = (np.cumsum(is_first) - 1)[above[first + width - 1]]
    columns = (parents, width, count[first], indptr[first])
    return list(zip(*(column.tolist() for column in columns), strict=True))
