"""Information matrices as the precisions kappa and tau of the isotropic cost, and back.

The formulas are those of the code of SE-Sync (Rosen et al. 2019).
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import PoseGraph, connecting_edges, matrices_of_edges

# Bounds on eigenvalues of a matrix that is scaled to ones on its diagonal. An eigenvalue above the
# first counts as positive. One below the second is negative beyond all rounding, also that of the
# eigenvalue itself.
LEAST_SCALED = 1e-12
_SURELY_NEGATIVE = -1e-10
# A matrix whose smallest eigenvalue is below this has directions that it does not measure.
LEAST_DEFINITE = 1e-13
# Negative eigenvalues down to here are what six significant digits make of a zero, after the
# scaling, and six decimals, as a share of the largest eigenvalue.
_SIX_DIGITS = 1e-5
_SIX_DECIMALS = 1e-6
# Negative eigenvalues up to here are hidden by the rounding of doubles, see `_ROUNDED_ENTRIES`.
_NO_ROUNDING = 2.0**-46
# Information of directions without any, in F, as a share of the largest of the block.
UNMEASURED_SHARE = 1e-6
_REMEMBERED = 2**16  # matrices of which exact arithmetic has said whether they are semidefinite
# Share of the diagonal that the rounding of the entries can hide. This share is added to the
# diagonal of a matrix that is semidefinite but for rounding.
_ROUNDED_ENTRIES = 2.0**-45
_WAYS_OUT = (
    "so that chi2 can be negative: correct them, leave out their coupling blocks "
    "(pgo_models.without_indefinite_coupling), or solve F"
)


def edge_precisions(information: Array) -> tuple[Array, Array]:
    """Precisions (kappa, tau), each (m,), of information matrices (m, k, k).

    In space, k = 6: tau = 3 / tr(I_tt^-1) and kappa = 3 / (2 tr(I_rr^-1)). In the plane, k = 3: tau
    = 2 / tr(I_tt^-1), and kappa = I_theta. The blocks themselves are inverted, not the marginal
    information; blocks of zeros give 0. Of a singular block a direction without information counts
    as if it had `UNMEASURED_SHARE` of the largest entry of its diagonal: F has one precision for
    all directions. The units are those of the matrices, per radian^2 and per metre^2.

    A rotation error theta costs kappa ||R - I||_F^2 = 4 kappa (1 - cos theta), about 2 kappa
    theta^2, where a Gaussian error costs I_theta theta^2 (neither F nor tau ||.||^2 has a factor
    1/2). So kappa = I_theta, by which optima of 2D graphs are published, gives rotations in the
    plane twice that weight against translations; in space there is no such factor.
    """
    if information.shape[-1] == 3:
        tau = 2.0 / trace_of_inverse(_without_null_directions(information[:, :2, :2]))
        return information[:, 2, 2], tau
    kappa = 1.5 / trace_of_inverse(_without_null_directions(information[:, 3:, 3:]))
    tau = 3.0 / trace_of_inverse(_without_null_directions(information[:, :3, :3]))
    return kappa, tau


def are_singular(blocks: Array) -> BoolArray:
    """Whether blocks (m, k, k) measure something, but not in every direction, (m,)."""
    is_nonzero = blocks.any(axis=(1, 2))
    is_singular = np.zeros(len(blocks), dtype=bool)
    is_singular[is_nonzero] = ~are_definite(blocks[is_nonzero], LEAST_DEFINITE)
    return is_singular


def partial_edges(graph: PoseGraph) -> BoolArray:
    """Return which edges, (m,), measure rotations or positions in some directions alone.

    A block of their information matrix is singular and not zero.
    """
    if graph.information is None:
        return np.zeros(graph.num_edges, dtype=bool)
    d = graph.d
    is_partial = ~are_definite(graph.information, LEAST_SCALED)
    if not is_partial.any():  # as of most graphs
        return is_partial
    of_translations = are_singular(graph.information[:, :d, :d])
    of_rotations = are_singular(graph.information[:, d:, d:])
    is_partial = of_translations | of_rotations
    # Indefinite matrices are none.
    _, is_indefinite = _semidefinite(graph.information[is_partial], d)
    is_partial[is_partial] = ~is_indefinite
    return is_partial


def without_negative_rounding(information: Array, d: int) -> tuple[Array, BoolArray]:
    """Semidefinite matrices, (m, k, k), for those that are but for the digits of their file.

    Also returned is which of them had to be changed. A matrix that measures no more than a few
    directions has eigenvalues that are zero, and written with a few digits some become negative:
    these are taken for zero. Matrices with a larger negative eigenvalue are left alone.
    """
    is_changed = np.zeros(len(information), dtype=bool)
    settled = information
    for block in (slice(0, d), slice(d, None), slice(0, None)):
        blocks = settled[:, block, block]
        doubtful = np.flatnonzero(are_singular(blocks))
        if not len(doubtful):
            continue
        lowest = lowest_scaled(blocks[doubtful])
        is_by_digits = lowest >= -_SIX_DIGITS
        is_rounded = is_by_digits
        if block.stop == d or block.start == d:  # entries of one unit
            is_rounded = is_negative_by_rounding(blocks[doubtful])
        is_rounded &= lowest < -_NO_ROUNDING
        if not is_rounded.any():
            continue
        settled = settled.copy()
        by_digits = doubtful[is_rounded & is_by_digits]
        scaled, scale = scaled_blocks(blocks[by_digits])
        raised = _clipped_at_zero(scaled) / (scale[:, :, None] * scale[:, None, :])
        settled[by_digits, block, block] = raised
        by_decimals = doubtful[is_rounded & ~is_by_digits]
        settled[by_decimals, block, block] = _clipped_at_zero(blocks[by_decimals])
        is_changed[doubtful[is_rounded]] = True
    return settled, is_changed


def is_negative_by_rounding(blocks: Array) -> BoolArray:
    """Whether six digits or decimals explain the negative eigenvalues of blocks, (m, k, k).

    All entries of a block have one unit. Blocks without negative eigenvalues count as explained.
    """
    values = np.linalg.eigvalsh(blocks)
    is_by_decimals = values[:, 0] >= -_SIX_DECIMALS * values[:, -1]
    return np.asarray(is_by_decimals | (lowest_scaled(blocks) >= -_SIX_DIGITS))


def _clipped_at_zero(matrices: Array) -> Array:
    """Symmetric matrices, (m, k, k), with zero for their negative eigenvalues."""
    values, vectors = np.linalg.eigh(matrices)
    raised = (vectors * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return np.asarray(0.5 * (raised + np.swapaxes(raised, 1, 2)))


def lowest_scaled(blocks: Array) -> Array:
    """Smallest eigenvalue, (m,), of blocks (m, k, k) that are scaled to ones on the diagonal.

    A row whose diagonal entry is zero is semidefinite only with zeros: else -inf is returned.
    """
    scaled, _ = scaled_blocks(blocks)
    diagonal = np.einsum("mkk->mk", blocks)
    is_empty = diagonal == 0.0
    is_crossed = (is_empty[:, :, None] & (blocks != 0.0)).any(axis=(1, 2))
    lowest = np.linalg.eigvalsh(scaled)[:, 0] if len(blocks) else np.zeros(0)
    return np.asarray(np.where(is_crossed, -np.inf, lowest))


def _without_null_directions(blocks: Array) -> Array:
    """Blocks, (m, k, k), with `UNMEASURED_SHARE` of information where singular ones have none."""
    singular = np.flatnonzero(are_singular(blocks))
    if not len(singular):
        return blocks
    filled_blocks = blocks.copy()
    largest = np.einsum("mkk->mk", blocks[singular]).max(axis=1)
    values, vectors = np.linalg.eigh(blocks[singular])
    raised = np.maximum(values, UNMEASURED_SHARE * largest[:, None])
    filled_blocks[singular] = (vectors * raised[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return filled_blocks


def proper_information(graph: PoseGraph) -> Array:
    """Information matrices of chi2, (m, k, k): symmetric, and semidefinite where they couple.

    They are the whole matrices of the graph, or those of kappa and tau (`isotropic_information`)
    where it has none. A matrix with coupling blocks whose eigenvalues are negative by the rounding
    of its entries alone has 2^-45 of its diagonal added. A GraphError, which names the first edge,
    when a matrix is indefinite (`indefinite_edges`). The blocks of matrices without coupling are
    checked by `information_cost`.
    """
    information = _symmetric_information(graph)
    raised, is_indefinite = _semidefinite(information, graph.d)
    if is_indefinite.any():
        problem = text_of_indefinite(graph, is_indefinite)
        raise GraphError(f"{problem}, {_WAYS_OUT}")
    return raised


def gaussian_information(graph: PoseGraph) -> Array:
    """Inverse covariances of the errors of the measurements, (m, k, k), for tests of measurements.

    No Gaussian has an indefinite matrix: of such a matrix the coupling block is left out. Nothing
    is proved with these matrices; those of chi2 are `proper_information`.
    """
    information = _symmetric_information(graph)
    raised, is_indefinite = _semidefinite(information, graph.d)
    if not is_indefinite.any():
        return raised
    return _without_coupling(raised, is_indefinite, graph.d)


def indefinite_edges(graph: PoseGraph) -> BoolArray:
    """Return which edges have a coupling block that makes their information matrix indefinite.

    Such a matrix has a negative eigenvalue beyond the rounding of its entries, so that its share of
    chi2 can be negative. `Weighting.INFORMATION` refuses such a matrix, and
    `without_indefinite_coupling` leaves its coupling block out. F uses no coupling block. Matrices
    without one are not checked here.

    Cholesky factors and eigenvalues decide where they are clear, exact arithmetic elsewhere.
    """
    information = _symmetric_information(graph)
    _, is_indefinite = _semidefinite(information, graph.d)
    return is_indefinite


def without_indefinite_coupling(graph: PoseGraph) -> PoseGraph:
    """Return the graph without the coupling blocks that make information matrices indefinite.

    The blocks I_tr of these matrices are set to zero. The chi2 of the graph is then another than
    that of its file, which can be negative. `PoseGraph.uncoupled` says which edges have lost their
    block, and `Solution.note` how many.

    Measurements, kappa and tau stay; a graph without such matrices is returned as it is.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from pgo_models.graphs.scenes import circle
    >>> graph = circle(np.random.default_rng(0))
    >>> information = matrices_of_edges(graph)
    >>> information[5, 0, 3] = information[5, 3, 0] = 1e9
    >>> changed = without_indefinite_coupling(replace(graph, information=information))
    >>> np.flatnonzero(changed.uncoupled).tolist(), float(changed.information[5, 0, 3])
    ([5], 0.0)
    """
    is_indefinite = indefinite_edges(graph)
    if graph.information is None or not is_indefinite.any():
        return graph
    uncoupled = is_indefinite
    if graph.uncoupled is not None:
        uncoupled = graph.uncoupled | is_indefinite
    information = _without_coupling(graph.information, is_indefinite, graph.d)
    return replace(graph, information=information, uncoupled=uncoupled)


def text_of_indefinite(graph: PoseGraph, is_indefinite: BoolArray, place: str = "") -> str:
    """Text with the number of indefinite matrices and the first; `place` is its `file:line`."""
    first = int(np.argmax(is_indefinite))
    first_matrix = _symmetric_information(graph)[first : first + 1]
    scaled, _ = scaled_blocks(first_matrix)
    smallest = np.linalg.eigvalsh(scaled)[0, 0]
    share = f"{is_indefinite.sum()} of {graph.num_edges} edges"
    label = graph.edge_label(first)
    which = f"{place}, {label}" if place else label
    return (
        f"information matrices of {share} are indefinite "
        f"(first {which}: eigenvalue {smallest:.3g} beside ones on the diagonal)"
    )


def are_definite(blocks: Array, least: float) -> BoolArray:
    """Whether symmetric blocks (m, k, k) are above `least` times I, (m,).

    They are scaled first, to ones where the diagonal is positive.
    """
    # The blocks come last, (k, k, m): then every operation runs through contiguous memory.
    shifted = np.moveaxis(blocks, 0, -1).copy()
    diagonal = np.einsum("kkm->km", shifted)  # a view
    scale = _scale_to_ones(diagonal)
    shifted *= scale[:, None]
    shifted *= scale
    diagonal -= least
    if _have_positive_pivots(shifted.copy()):
        return np.ones(len(blocks), dtype=bool)
    smallest = np.linalg.eigvalsh(np.moveaxis(shifted, -1, 0))[:, 0]
    return np.asarray(smallest > 0.0)


def _have_positive_pivots(U: Array) -> bool:
    """Whether all blocks, (k, k, m), have a factor L D L^T with D > 0, as definite ones have.

    All are eliminated at once, in a fraction of the time of their Cholesky factors. The array is
    overwritten.
    """
    for k in range(len(U)):
        pivot = U[k, k].copy()
        if not (pivot > 0.0).all():
            return False
        U[k + 1 :] -= U[k + 1 :, k, None] / pivot * U[k]
    return True


def _scale_to_ones(diagonal: Array) -> Array:
    """What scales rows and columns so that a positive diagonal becomes one."""
    return np.asarray(1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)))


def scaled_blocks(blocks: Array) -> tuple[Array, Array]:
    """Blocks D A D, (m, k, k), with ones on the diagonal where that is positive, and D, (m, k)."""
    scale = _scale_to_ones(np.einsum("mkk->mk", blocks))
    scaled = blocks * scale[:, :, None]
    scaled *= scale[:, None, :]
    return scaled, scale


def uncoupled_share(information: Array, d: int) -> Array:
    """Largest share, (m,), for which I >= share blockdiag(I_tt, I_rr).

    It is 1 - ||I_tt^-1/2 I_tr I_rr^-1/2||_2, whose square is the largest eigenvalue of I_rr^-1
    I_tr^T I_tt^-1 I_tr.
    """
    I_tt = information[:, :d, :d]
    I_tr = information[:, :d, d:]
    I_rr = information[:, d:, d:]
    singular = are_singular(I_tt)[:, None, None] | are_singular(I_rr)[:, None, None]
    # A coupling of singular blocks leaves no share.
    I_tt = np.where(singular, np.eye(d), I_tt)
    I_rr = np.where(singular, np.eye(I_rr.shape[1]), I_rr)
    I_tr = np.where(singular, 0.0, I_tr)
    product = eliminated_products(filled(I_tt), I_tr)
    if product.shape[1] == 1:
        squared_norm = np.abs(product / filled(I_rr))[:, 0, 0]
    else:
        eigenvalues = np.linalg.eigvals(np.linalg.solve(filled(I_rr), product))
        squared_norm = np.abs(eigenvalues).max(axis=1)
    return np.asarray(np.where(singular[:, 0, 0], 0.0, 1.0 - np.sqrt(squared_norm)))


def eliminated_products(A: Array, B: Array) -> Array:
    """B^T A^-1 B, (m, p, p), of definite blocks A, (m, k, k), and B, (m, k, p).

    All blocks are eliminated at once, A = L D L^T: it is the product of D^-1/2 L^-1 B with itself.
    """
    # The blocks come last, as in `are_definite`.
    U = np.moveaxis(A, 0, -1).copy()
    V = np.moveaxis(B, 0, -1).copy()
    products = np.zeros((B.shape[2], B.shape[2], len(B)))
    for k in range(len(U)):
        pivot = U[k, k].copy()
        products += V[k, :, None] * V[k] / pivot
        multiplier = U[k + 1 :, k, None] / pivot
        U[k + 1 :] -= multiplier * U[k]
        V[k + 1 :] -= multiplier * V[k]
    return np.moveaxis(products, -1, 0)


def smallest_eigenvalues(blocks: Array) -> Array:
    """Smallest eigenvalue, (m,), of symmetric blocks (m, k, k)."""
    size = blocks.shape[1]
    if size == 1:
        return np.asarray(blocks[:, 0, 0])
    if size > 2:
        return np.asarray(np.linalg.eigvalsh(blocks)[:, 0])
    mean = 0.5 * (blocks[:, 0, 0] + blocks[:, 1, 1])
    half_difference = 0.5 * (blocks[:, 0, 0] - blocks[:, 1, 1])
    return np.asarray(mean - np.hypot(half_difference, blocks[:, 1, 0]))


def condition(blocks: Array) -> Array:
    """Largest over smallest eigenvalue, (m,), of blocks (m, k, k); 1 of zero blocks.

    It is inf of blocks that do not measure every direction.
    """
    values = np.linalg.eigvalsh(filled(blocks))
    smallest = np.where(are_singular(blocks), 0.0, values[:, 0])
    largest = values[:, -1]
    ratio = np.full(len(blocks), np.inf)
    np.divide(largest, smallest, out=ratio, where=smallest > 0.0)
    return ratio


def filled(A: Array) -> Array:
    """Blocks (m, k, k) with the identity in place of those that are zero."""
    is_zero = ~A.any(axis=(1, 2), keepdims=True)
    identity = np.eye(A.shape[1])
    return np.asarray(A + is_zero * identity)


def trace_of_inverse(A: Array) -> Array:
    """tr(A^-1), (m,), of symmetric blocks (m, k, k); inf of blocks of zeros.

    All blocks are eliminated at once, A = L D L^T, in a fraction of the time of their inverses. The
    trace is the sum of the squares of D^-1/2 L^-1.
    """
    # The edges come last, (k, k, m): then every operation runs through contiguous memory.
    edges_last = np.moveaxis(filled(A), 0, -1)
    U = np.ascontiguousarray(edges_last)
    identity = np.eye(len(U))
    L_inverse = identity[:, :, None] + np.zeros(len(A))
    is_nonzero = A.any(axis=(1, 2))
    trace = np.where(is_nonzero, 0.0, np.inf)
    pivots = np.einsum("kkm->km", U)  # a view: the pivots change with U
    for k, pivot in enumerate(pivots):
        squares = L_inverse[k] ** 2
        trace += np.sum(squares, axis=0) / pivot
        multiplier = U[k + 1 :, k, None] / pivot
        U[k + 1 :] -= multiplier * U[k]
        L_inverse[k + 1 :] -= multiplier * L_inverse[k]
    return trace


def extreme_weight(graph: PoseGraph, has_translations: bool = True) -> tuple[float, int, str]:
    """Largest ratio of two weights of a connected graph, the edge to blame, and a sentence on it.

    Where rotations alone are the unknowns, tau is no weight.

    Rounding beside the heaviest edge hides the lighter edges that alone hold a part of the graph.
    The lightest such edge is the lightest one of a maximum spanning tree. To blame is the heaviest
    edge or this one, whichever is farther from the median.
    """
    extremes = []
    for kind in ("kappa", "tau") if has_translations else ("kappa",):
        weight = getattr(graph, kind)
        # Only where all edges have this weight: some graphs measure positions alone, or rotations.
        if (weight > 0).all():
            extremes.append(_extreme_weight_of(graph, kind, weight))

    def rounded_size(extreme: tuple[float, int, str]) -> float:
        # Rounded, so that kappa is named where both ratios are equal but for rounding.
        return round(float(np.log(extreme[0])), 9)

    return max(extremes, default=(0.0, 0, ""), key=rounded_size)


def _extreme_weight_of(graph: PoseGraph, kind: str, weight: Array) -> tuple[float, int, str]:
    """Like `extreme_weight`, for the positive kappa or tau of the graph alone."""
    ratio_to_median = weight / np.median(weight)
    no_edges = np.zeros(graph.num_edges, dtype=bool)
    maximum_tree = connecting_edges(graph, no_edges, -weight)
    heaviest = int(np.argmax(weight))
    lightest = int(maximum_tree[np.argmin(weight[maximum_tree])])
    e = max(heaviest, lightest, key=lambda edge: abs(np.log(ratio_to_median[edge])))
    name_i = graph.pose_name(int(graph.i[e]))
    name_j = graph.pose_name(int(graph.j[e]))
    size = f"{weight[e]:.3g}, {ratio_to_median[e]:.3g} times the median"
    text = f"{kind} of edge {name_i} -> {name_j} is {size}"
    return float(weight[heaviest] / weight[lightest]), e, text


def _symmetric_information(graph: PoseGraph) -> Array:
    information = matrices_of_edges(graph)
    return np.asarray(0.5 * (information + np.swapaxes(information, 1, 2)))


def _without_coupling(information: Array, chosen: BoolArray, d: int) -> Array:
    """Matrices with zeros in the coupling blocks of the chosen ones."""
    uncoupled = information.copy()
    uncoupled[chosen, :d, d:] = 0.0
    uncoupled[chosen, d:, :d] = 0.0
    return uncoupled


def _semidefinite(information: Array, d: int) -> tuple[Array, BoolArray]:
    """Matrices, raised where rounding alone makes them indefinite; which are indefinite, (m,).

    Of matrices without a coupling block the two blocks are judged, of which one may be zero.
    """
    is_indefinite = np.zeros(len(information), dtype=bool)
    if are_definite(information, LEAST_SCALED).all():  # as of most graphs
        return information, is_indefinite
    is_coupled = information[:, :d, d:].any(axis=(1, 2))
    coupled = np.flatnonzero(is_coupled)
    is_definite = are_definite(information[coupled], LEAST_SCALED)
    is_doubtful = are_singular(information[:, :d, :d]) | are_singular(information[:, d:, d:])
    is_doubtful[coupled] = ~is_definite
    # Directions along axes without any entry: what is left of most such matrices is definite.
    filled_axes = with_empty_axes_filled(information[is_doubtful])
    is_doubtful[is_doubtful] = ~are_definite(filled_axes, LEAST_SCALED)
    doubtful = np.flatnonzero(is_doubtful)
    if not len(doubtful):
        return information, is_indefinite
    information = information.copy()
    # Edges often share a matrix: each is judged once.
    matrices, which = np.unique(information[doubtful], axis=0, return_inverse=True)
    matrix_of_edge = which.ravel()
    scaled, _ = scaled_blocks(matrices)
    lowest = np.linalg.eigvalsh(scaled)[:, 0]
    for k, matrix in enumerate(matrices):
        same = doubtful[matrix_of_edge == k]
        if lowest[k] < _SURELY_NEGATIVE:
            is_indefinite[same] = True
        elif not is_semidefinite_exactly(matrix):
            diagonal = np.diag(np.diag(matrix))
            raised = matrix + _ROUNDED_ENTRIES * diagonal
            is_indefinite[same] = not is_semidefinite_exactly(raised)
            information[same] = raised
    return information, is_indefinite


def with_empty_axes_filled(information: Array) -> Array:
    """Matrices, (m, k, l), with a one on the diagonal of rows without any entry."""
    filled_axes = information.copy()
    is_empty = ~information.any(axis=2)
    size = information.shape[1]
    diagonal = np.einsum("mkk->mk", filled_axes[:, :, :size])  # a view
    diagonal[is_empty] = 1.0
    return filled_axes


def is_semidefinite_exactly(matrix: Array) -> bool:
    """Whether a symmetric matrix of doubles, (k, k), has no negative eigenvalue, exactly.

    The matrix is scaled to whole numbers and eliminated. Pivots must not be negative, and in the
    row of a pivot of zero all entries must be zero.
    """
    size = len(matrix)
    entries = np.ascontiguousarray(matrix, dtype=float).tobytes()
    return _has_no_negative_pivot(entries, size)


@lru_cache(maxsize=_REMEMBERED)
def _has_no_negative_pivot(entries: bytes, size: int) -> bool:
    """Like `is_semidefinite_exactly`; matrices of a graph are asked for several times."""
    matrix = np.frombuffer(entries).reshape(size, size)
    rows = _as_whole_numbers(matrix)
    while rows:
        pivot, *pivot_row = rows[0]
        if pivot < 0 or (pivot == 0 and any(pivot_row)):
            return False
        # A pivot of zero has zeros in its row and column: nothing is subtracted.
        factor = pivot if pivot > 0 else 1
        rows = [_eliminated(row, pivot_row, factor) for row in rows[1:]]
    return True


def _as_whole_numbers(matrix: Array) -> list[list[int]]:
    """Entries of a matrix of doubles, all times one power of two that makes them whole."""
    entries = matrix.tolist()
    fractions = [[entry.as_integer_ratio() for entry in row] for row in entries]
    # Denominators of doubles are powers of two, so that the largest is a common one.
    common = max(denominator for row in fractions for _, denominator in row)
    rows = []
    for row in fractions:
        integers = [numerator * (common // denominator) for numerator, denominator in row]
        rows.append(integers)
    return rows


def _eliminated(row: list[int], pivot_row: list[int], factor: int) -> list[int]:
    """`factor` times a row, less its first entry times the row of the pivot, without column one."""
    first, *others = row
    columns = zip(others, pivot_row, strict=True)
    return [factor * entry - first * above for entry, above in columns]
