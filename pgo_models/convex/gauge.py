"""A common rotation that leaves a model as it is, and the model with one variable held.

Rotations that are only compared with each other, as R_j with R_i R_ij, may all be turned from the
left, R_i -> Q R_i, and vectors beside them, t_i -> Q t_i; in other conventions from the right,
R_i -> R_i Q. Every point can then be turned so that one variable is the identity: the least J is
that of the model with this variable held. Without this S has a kernel, and is definite by a shift
alone, as a pose graph's is that is not grounded (`pgo_models.certificates.lower_bound`).

That a model is of this kind is seen exactly. J has to be a sum of weighted squares of residuals,
each of which has numbers of one row of all variables alone (of one column, from the right), and
the residuals of every row have to be the same numbers.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components

from pgo_models.convex.constraint_sets import Orthonormal, Rotations, UnitColumns, UnitRows
from pgo_models.convex.quadratic_form import Block, Gauge, QuadraticForm
from pgo_models.graphs.pose_graph import IntArray


def with_gauge_held(form: QuadraticForm) -> QuadraticForm:
    """The form with one variable held at the identity where that loses nothing, else itself."""
    if form.E.shape[0] or form.G.shape[0] or not np.isnan(form.fixed[:-1]).all():
        return form
    for is_left in (True, False):
        block = _block_to_hold(form, is_left=is_left)
        entries = None if block is None else _turned_entries(form, is_left=is_left)
        if block is None or entries is None:
            continue
        fixed = form.fixed.copy()
        held = form.blocks[block]
        fixed[held.coordinates] = held.coordinates_of(np.eye(held.shape[0]))
        return replace(form, fixed=fixed, gauge=Gauge(block, is_left, entries))
    return form


def _block_to_hold(form: QuadraticForm, *, is_left: bool) -> int | None:
    """The square variable with most entries in J; None where a set is not kept by rotations."""
    sides = set()
    for block in form.blocks:
        is_vector = len(block.shape) == 1
        sides.add(block.shape[0] if is_left or is_vector else block.shape[1])
        kept = (Orthonormal, UnitColumns)
        if len(block.sets) > 1 or not isinstance(block.sets[0], kept):
            return None
        is_of_rows = isinstance(block.sets[0], UnitRows)
        is_of_columns = isinstance(block.sets[0], UnitColumns) and not is_of_rows
        if (is_left and is_of_rows) or (not is_left and (is_of_columns or is_vector)):
            return None
    candidates = [k for k, block in enumerate(form.blocks) if _is_square(block)]
    has_rotations = any(isinstance(block.sets[0], Rotations) for block in form.blocks)
    if has_rotations:
        candidates = [k for k in candidates if isinstance(form.blocks[k].sets[0], Rotations)]
    if len(sides) > 1 or not candidates:
        return None
    weights = np.diff(form.from_u.indptr)
    return max(candidates, key=lambda k: int(weights[form.blocks[k].coordinates].sum()))


def _is_square(block: Block) -> bool:
    is_matrix = len(block.shape) == 2 and block.shape[0] == block.shape[1]
    return is_matrix and isinstance(block.sets[0], Orthonormal)


def _turned_entries(form: QuadraticForm, *, is_left: bool) -> IntArray | None:
    """Entries of w, those of every row (or column) of all variables; None where J may change."""
    weighted = np.flatnonzero(abs(form.P).sum(axis=0))
    is_diagonal = not (form.P - diags_array(form.P.diagonal())).count_nonzero()
    if form.c.any() or not is_diagonal:
        return None
    residuals = csr_array(form.T[weighted])
    residuals.eliminate_zeros()
    of_entries = csr_array(residuals[:, :-1])
    has_entries = np.diff(of_entries.indptr) > 0
    if residuals[np.flatnonzero(has_entries)][:, [-1]].count_nonzero():
        return None  # a residual that has a constant beside its entries
    labels = _labels(form, csr_array(of_entries), is_left=is_left)
    if labels is None:
        return None
    of_residuals = labels[of_entries.indices[of_entries.indptr[:-1][has_entries]]]
    rows = np.flatnonzero(has_entries)
    all_entries = [np.flatnonzero(labels == label) for label in range(int(labels.max()) + 1)]
    numbers: list[list[Any]] = []
    for label, entries in enumerate(all_entries):
        of_label = rows[of_residuals == label]
        part = csr_array(csc_array(of_entries[of_label])[:, entries])
        part.sort_indices()
        weights = form.P.diagonal()[weighted[of_label]]
        numbers.append([part.shape, part.indptr, part.indices, part.data, weights])
    for others in numbers[1:]:
        both = zip(numbers[0], others, strict=True)
        if not all(np.array_equal(one, other) for one, other in both):
            return None
    return np.array(all_entries)


def _labels(form: QuadraticForm, residuals: csr_array, *, is_left: bool) -> IntArray | None:
    """The row (or column) of every entry of w, -1 of those that J does not have.

    Variables without a set have that of what they are together with in residuals.
    """
    labels = np.full(form.T.shape[1] - 1, -1)
    start = 0
    for block in form.blocks:
        places = np.arange(int(np.prod(block.shape)))
        labels[start + places] = places % block.shape[0] if is_left else places // block.shape[0]
        start += len(places)
    pattern = csr_array(abs(residuals.T) @ abs(residuals))
    of_components = connected_components(pattern, directed=False)[1]
    known = labels >= 0
    label_of = np.full(of_components.max() + 1, -1)
    label_of[of_components[known]] = labels[known]
    if (label_of[of_components[known]] != labels[known]).any():
        return None
    labels = label_of[of_components]
    in_J = np.diff(csc_array(residuals).indptr) > 0
    return None if (labels[in_J] < 0).any() else labels
