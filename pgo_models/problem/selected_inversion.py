"""Selected inversion: entries of the inverse on the pattern of a sparse Cholesky factor.

For Z = (L L^T)^-1, J the columns of a supernode and I the rows below them (Takahashi, Fagan & Chen
1973, Z L = L^-T):

    G = L_IJ L_JJ^-1,    Z_IJ = -Z_II G,    Z_JJ = L_JJ^-T L_JJ^-1 - G^T Z_IJ.

I is among the rows of the parent supernode in the elimination tree. The front of a supernode is Z
in its rows and columns. Fronts are computed from the roots of the tree to its leaves, so that the
front of the parent, which contains Z_II, is known.
"""

from functools import cache

import numpy as np
from scipy.linalg.lapack import dtrtri
from scipy.sparse import csc_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray


def selected_inverse(L: csc_array) -> Array:
    """Values of (L L^T)^-1 at the stored entries of L, in their order.

    L is as of `SymbolicCholesky.lower_factor`: lower triangular, rows sorted, all of its pattern
    stored, zeros included.
    """
    data = L.data
    indices = L.indices
    supernodes = _supernodes(L)
    parents = [parent for parent, *_ in supernodes]
    # Number of children of every supernode that still need its front. `_supernodes` gives roots the
    # last supernode for a parent: they are counted there, but read no front.
    waiting = np.bincount(parents, minlength=len(supernodes)).tolist()
    # Rows and front of the supernodes that children wait for.
    fronts: dict[int, tuple[IntArray, Array]] = {}
    trapezoid = cache(_trapezoid)
    Z = np.empty_like(data)
    for k in reversed(range(len(supernodes))):
        parent, w, size, begin = supernodes[k]
        is_needed = waiting[k] > 0
        # L_T, (w, size): the transposed columns of the supernode, of which L stores a trapezoid.
        stored = trapezoid(w, size)
        own = slice(begin, begin + len(stored))
        flat = np.zeros(w * size)
        flat[stored] = data[own]
        L_T = flat.reshape(w, size)
        rows = indices[begin : begin + size]
        # The first w rows of the front are Z_JJ and Z_JI; the others are for the children.
        front = np.empty((size if is_needed else w, size))
        inverse, _ = dtrtri(L_T[:, :w])
        front[:w, :w] = inverse @ inverse.T
        if size > w:
            parent_rows, parent_front = fronts[parent]
            places = parent_rows.searchsorted(rows[w:])
            Z_II = parent_front.take(places, axis=0).take(places, axis=1)
            G_T = inverse @ L_T[:, w:]
            product = G_T @ Z_II
            front[:w, w:] = -product
            front[:w, :w] += product @ G_T.T
            if is_needed:
                front[w:, :w] = front[:w, w:].T
                front[w:, w:] = Z_II
            waiting[parent] -= 1
            if not waiting[parent]:
                del fronts[parent]
        if is_needed:
            fronts[k] = rows, front
        Z[own] = front[:w].ravel().take(stored)
    return np.asarray(Z)


def _trapezoid(width: int, size: int) -> IntArray:
    """Positions in L_T, (width, size), read row by row, of the entries that L stores."""
    row = np.arange(width)[:, None]
    column = np.arange(size)
    return np.flatnonzero(column >= row)


def _supernodes(L: csc_array) -> list[tuple[int, int, int, int]]:
    """Parent, width, number of rows, and first position in `L.data`, of every supernode.

    A supernode is a run of columns; the rows of each are its own diagonal and the rows of the next
    column. The number of rows is that of the first column. The parent of a root means nothing.
    """
    side = L.shape[0]
    indptr = L.indptr.astype(np.int64)
    begin = indptr[:-1]
    count = np.diff(indptr)
    # Parent of a column in the elimination tree: the row of its first entry off the diagonal.
    has_parent = count > 1
    column_parent = np.full(side, -1)
    column_parent[has_parent] = L.indices[begin[has_parent] + 1]
    # A column begins a supernode unless it is the parent of the one before and has one row less.
    is_other_parent = column_parent[:-1] != np.arange(1, side)
    has_other_rows = count[:-1] != count[1:] + 1
    is_first = np.append(True, is_other_parent | has_other_rows)
    supernode = np.cumsum(is_first) - 1
    first = np.flatnonzero(is_first)
    width = np.diff(np.append(first, side))
    last = first + width - 1
    parent = supernode[column_parent[last]]
    fields = (parent, width, count[first], begin[first])
    return list(zip(*(field.tolist() for field in fields), strict=True))
