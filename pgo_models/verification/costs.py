"""The cost of a graph as a quadratic form: F, which is one, or a tangent of chi2, nowhere above it.

The rows of pose i are X_i = (t_i^T; R_i^T). An edge has the residual delta = X_j - T X_i, where
T = (1, t_ij^T; 0, R_ij^T); that of a position is the first row alone.

**F** is the sum of tr(delta^T W delta) with W = diag(tau, kappa I), tau = d / tr(I_tt^-1), and
kappa = 3 / (2 tr(I_rr^-1)) in space, I_theta in the plane (SE-Sync). **F(R)**, of rotations alone,
has tau = 0.

**chi2.** In the frame of pose i let r = R_i^T (t_j - t_i) - t_ij, and let E = R_i^T R_j R_ij^T be a
turn by theta about a. Both s = a sin theta and H = (1 - cos theta) a a^T are linear in E. With the
blocks of the information matrix turned into that frame, the cost of an edge is

    r^T I_tt r + 2 r^T I_tr s + 2 tr(I_rr H) = tr(delta^T W delta) + u^T J u + tr(H J_ss H),
    u = (r, s),   J = (I_tt - tau I, I_tr; I_tr^T, J_ss),   W = blockdiag(tau, W_R),

for any tau and J_ss, where W_R = tr(I_rr - J_ss) / 2 I - (I_rr - J_ss), and in the plane
W_R = (I_theta - J_ss) / 2 I. For tr(W_R (2 I - E - E^T)) = 2 (1 - cos theta) a^T (I_rr - J_ss) a by
Rodrigues' formula, and 2 (1 - cos theta) a^T J_ss a = s^T J_ss s + tr(H J_ss H). With
J_ss = I_tr^T (I_tt - tau I)^-1 I_tr and a tau below the smallest eigenvalue of I_tt both J and J_ss
are positive semidefinite, so that the last two terms are a convex function of Z = delta R_i, in
which u and H are linear. Let 2 C be its gradient at some Z'. The function is quadratic, so that its
value at Z' is <C, Z'>, and being convex it is at least its tangent 2 <C, Z> - <C, Z'>. There
<C, delta R_i> = <C R_i^T, delta> is bilinear in the rows of X.

Any tau and J_ss will do that make J positive semidefinite, of which J_ss is a block. A proof may
say which: its multipliers and its handedness terms belong to the form that follows from them.

**Weights along the axes of the world.** Of a position measured from the world pose, in a frame that
is not turned, a proof may keep more: with any D >= 0, (d), for which J - diag(D, 0) is positive
semidefinite, the convex function is at least its tangent and sum_k D_k (r_k - r'_k)^2, r' being r
at Z'. With the world pose at (0, I) this is a square of one coordinate along axis k.

**A matrix that does not measure every direction** is semidefinite, and tau is zero where its I_tt
is singular: J is then semidefinite, which is checked exactly.

**A matrix that is semidefinite but for rounding**, as a file of so many digits has it, would make
chi2 negative somewhere. As everywhere in this project, chi2 is then that of the matrix with 2^-45
of its diagonal added (`proper_edge`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

from pgo_models.verification.balls import (
    Number,
    above,
    arb,
    arb_mat,
    beside,
    blocks_on_diagonal,
    diagonal,
    exact,
    first_bad_pivot,
    fmpq,
    fmpq_mat,
    identity,
    is_semidefinite,
    part,
    sum_of,
    symmetric,
)
from pgo_models.verification.measurements import WORLD, Edge
from pgo_models.verification.proof import ROTATION_COSTS, UNIT_COSTS, Split

RESOLUTION = 2.0**-26  # of a bisection, relative
BELOW = 1.0 - 2.0**-24  # of the largest tau: what is left of the matrix is well above rounding
COUPLED_SHARE = 0.5  # of the largest tau, so that J_ss stays moderate
SINGULAR_SHARE = 2.0**-20  # of it where the coupling leaves nothing of a matrix
ROUNDED_ENTRIES = fmpq(1, 2**45)  # share of the diagonal that the rounding of entries can hide
KEPT = 2**16  # information matrices whose weights are remembered


class StepFailedError(Exception):
    """A step of the verification fails: which, and why."""


class UndecidedError(StepFailedError):
    """A ball is too wide to tell its sign; with more bits it may not be."""


@dataclass(eq=False)
class QuadraticForm:
    """q(X) = tr(X^T S X) + constant; S in blocks, both S_ij and its transpose S_ji."""

    S: dict[int, dict[int, arb_mat]] = field(default_factory=dict)
    constant: arb = field(default_factory=arb)
    # Of poses and landmarks: sums of D, what the squares along every axis add to the row of t.
    D: dict[int, list[arb]] = field(default_factory=dict)

    def add(self, i: int, j: int, block: arb_mat) -> None:
        """Add a block to S_ij, and where i is not j its transpose to S_ji."""
        row = self.S.setdefault(i, {})
        row[j] = row[j] + block if j in row else block
        if i != j:
            self.S.setdefault(j, {})[i] = row[j].transpose()

    def product(self, X: dict[int, arb_mat]) -> dict[int, arb_mat]:
        """S X."""
        product = {}
        for i, row in self.S.items():
            product[i] = sum_of(block * X[j] for j, block in row.items())
        return product


@dataclass(frozen=True, eq=False)
class Weight:
    """How chi2 of an edge is split: tau, J_ss, and D along the axes of the world."""

    tau: fmpq
    J_ss: fmpq_mat
    D: tuple[fmpq, ...] = ()


@dataclass(frozen=True, eq=False)
class Tangent:
    """2 <C, Z> - value, nowhere above a convex function that has this value at some Z'."""

    C: arb_mat
    value: arb


def add_edge(
    form: QuadraticForm,
    edge: Edge,
    cost: str,
    X: dict[int, arb_mat],
    splits: Sequence[Split] = (),
) -> arb:
    """Add an edge to the form, and return its share of the cost at X, from the definition.

    Of the splits of chi2 the first that fits the edge is taken.
    """
    begin, end = residual_matrices(edge, X[edge.j].nrows())
    tangent: Tangent | None = None
    if cost == "chi2":
        edge = proper_edge(edge)
        weight = translation_weight(edge, splits)
        share, W, tangent = information_cost(edge, X[edge.i], X[edge.j], weight)
        if any(weight.D):
            sums = form.D.get(edge.j, [arb(0)] * edge.tag.d)
            form.D[edge.j] = [old + arb(new) for old, new in zip(sums, weight.D, strict=True)]
    else:
        share, W = isotropic_cost(edge, cost, end * X[edge.j] - begin * X[edge.i])
    weighted_begin = begin.transpose() * W
    weighted_end = end.transpose() * W
    form.add(edge.i, edge.i, weighted_begin * begin)
    form.add(edge.i, edge.j, -(weighted_begin * end))
    form.add(edge.j, edge.j, weighted_end * end)
    if tangent is not None:
        # 2 <C, delta R_i> = 2 <(0, C) X_i, delta>: S gets half of every product, and its transpose.
        no_translation = arb_mat(tangent.C.nrows(), 1)
        pull = beside(no_translation, tangent.C).transpose()
        pull_begin = pull * begin
        form.add(edge.i, edge.i, -(pull_begin + pull_begin.transpose()))
        form.add(edge.i, edge.j, pull * end)
        form.constant -= tangent.value
    return share


def residual_matrices(edge: Edge, rows_j: int) -> tuple[arb_mat, arb_mat]:
    """T and the matrix before X_j in delta, the identity; of a position their first rows."""
    d = edge.tag.d
    top = beside(identity(1), edge.t.transpose())
    if edge.tag.is_point:
        first_row = part(identity(d + 1), range(1), range(rows_j))
        return top, first_row
    bottom = beside(arb_mat(d, 1), edge.R.transpose())
    T = above(top, bottom)
    return T, identity(d + 1)


def isotropic_cost(edge: Edge, cost: str, delta: arb_mat) -> tuple[arb, arb_mat]:
    """Share of an edge in F, and W."""
    kappa, tau = precisions(edge.triangle, edge.tag.d, edge.tag.is_point)
    if cost in UNIT_COSTS:
        kappa = fmpq(kappa != 0)
        tau = fmpq(tau != 0)
    if cost in ROTATION_COSTS:
        tau = fmpq(0)
    kappas = [kappa] * (delta.nrows() - 1)
    W = diagonal([tau, *kappas])
    share = (delta.transpose() * W * delta).trace()
    return share, W


@lru_cache(maxsize=KEPT)
def precisions(triangle: tuple[fmpq, ...], d: int, is_point: bool) -> tuple[fmpq, fmpq]:
    """(kappa, tau) of F, exactly, from the upper triangle of an information matrix."""
    rows = symmetric(triangle, information_side(d, is_point))
    I_tt = [row[:d] for row in rows[:d]]
    tau = d * one_over_trace_of_inverse(I_tt)
    if is_point:
        return fmpq(0), tau
    I_rr = [row[d:] for row in rows[d:]]
    kappa = one_over_trace_of_inverse(I_rr)
    if d == 3:
        kappa = fmpq(3, 2) * kappa
    return kappa, tau


def measures_translation(edge: Edge) -> bool:
    """Whether the block I_tt of an edge is not zero."""
    d = edge.tag.d
    rows = symmetric(edge.triangle, information_side(d, edge.tag.is_point))
    return is_nonzero([row[:d] for row in rows[:d]])


def information_side(d: int, is_point: bool) -> int:
    """Rows of the information matrix of a relative pose, or of a position."""
    return d if is_point else 3 * d - 3


def is_nonzero(rows: list[list[fmpq]]) -> bool:
    """Whether a matrix has an entry that is not zero."""
    return any(map(any, rows))


def check_weights(block: list[list[fmpq]]) -> None:
    """Raise an error unless a block of an information matrix is zero or positive definite."""
    if is_nonzero(block) and first_bad_pivot(block) is not None:
        raise StepFailedError("the weights: a block of an information matrix is not definite")


def one_over_trace_of_inverse(rows: list[list[fmpq]]) -> fmpq:
    """1 / tr(A^-1) of a positive definite matrix; 0 of zeros, which say nothing."""
    if not is_nonzero(rows):
        return fmpq(0)
    check_weights(rows)
    inverse = fmpq_mat(rows).inv()
    diagonal_entries = (inverse[k, k] for k in range(len(rows)))
    return 1 / sum(diagonal_entries, fmpq(0))


def information_cost(
    edge: Edge, X_i: arb_mat, X_j: arb_mat, weight: Weight
) -> tuple[arb, arb_mat, Tangent | None]:
    """Share of an edge in chi2, W, and the tangent of what W leaves of it, if anything."""
    d = edge.tag.d
    R = edge.R
    translation = range(d)
    axes = range(d, edge.tag.side)
    I_tt = edge.block(translation, translation)
    I_tr = edge.block(translation, axes)
    tau = weight.tau
    J_ss = weight.J_ss
    I_tt_less_tau = fmpq_mat(less_tau(I_tt.tolist(), tau, d))
    # Translations: the residual r and I_tt - tau I, both in the frame of pose i.
    r = translation_residual(edge, X_i, X_j)
    D = R * arb_mat(I_tt_less_tau) * R.transpose()
    Dr = D * r
    share = inner(r, R * arb_mat(I_tt) * R.transpose() * r)
    if edge.tag.is_point:
        tangent = Tangent(Dr.transpose(), inner(r, Dr))
        return share, diagonal([tau]), tangent
    # Rotations: s = a sin theta and H = (1 - cos theta) a a^T of E.
    I_rr = edge.block(axes, axes)
    W_R = rotation_weight(arb_mat(I_rr - J_ss), d)
    W = blocks_on_diagonal(diagonal([tau]), W_R)
    turn = R if d == 3 else identity(1)  # of axes of rotations
    E = rotation_residual(R, X_i, X_j)
    s = axis_times_sine(E)
    H = axis_times_versine(E)
    turned_I_tr = R * arb_mat(I_tr) * turn.transpose()
    turned_I_rr = turn * arb_mat(I_rr) * turn.transpose()
    share += 2 * inner(r, turned_I_tr * s) + 2 * inner(H, turned_I_rr)
    if not any([*I_tt_less_tau.entries(), *I_tr.entries(), *J_ss.entries()]):
        return share, W, None
    # The tangent of u^T J u + tr(H J_ss H): half its gradients in r, s and H are y_r, y_s and
    # (N + N^T) / 2.
    turned_J_ss = turn * arb_mat(J_ss) * turn.transpose()
    y_r = Dr + turned_I_tr * s
    y_s = turned_I_tr.transpose() * r + turned_J_ss * s
    N = turned_J_ss * H
    # From E to the rotation rows Z_R of Z = delta R_i, in which E - I is linear: E - I = (R Z_R)^T.
    gradient_in_E = skew(y_s) + versine_adjoint(N + N.transpose(), d)
    half_gradient_in_E = gradient_in_E * arb(0.5)
    C = above(y_r.transpose(), (half_gradient_in_E * R).transpose())
    value = inner(r, y_r) + inner(s, y_s) + inner(H, N)
    return share, W, Tangent(C, value)


def translation_residual(edge: Edge, X_i: arb_mat, X_j: arb_mat) -> arb_mat:
    """Residual R_i^T (t_j - t_i) - t_ij, (d, 1)."""
    d = edge.tag.d
    R_i_transposed = part(X_i, range(1, d + 1), range(d))
    difference = part(X_j, range(1), range(d)) - part(X_i, range(1), range(d))
    return R_i_transposed * difference.transpose() - edge.t


def rotation_residual(R_ij: arb_mat, X_i: arb_mat, X_j: arb_mat) -> arb_mat:
    """Residual R_i^T R_j R_ij^T, (d, d), the identity where the edge fits."""
    d = R_ij.nrows()
    R_i_transposed = part(X_i, range(1, d + 1), range(d))
    R_j_transposed = part(X_j, range(1, d + 1), range(d))
    return R_i_transposed * R_j_transposed.transpose() * R_ij.transpose()


def proper_edge(edge: Edge) -> Edge:
    """The edge with a positive semidefinite information matrix; itself where it has one.

    A matrix that is semidefinite but for rounding has 2^-45 of its diagonal added. An indefinite
    one, whose chi2 can be negative, is refused.
    """
    triangle = proper_triangle(edge.triangle, edge.tag.d, edge.tag.is_point)
    return edge if triangle == edge.triangle else replace(edge, triangle=triangle)


@lru_cache(maxsize=KEPT)
def proper_triangle(triangle: tuple[fmpq, ...], d: int, is_point: bool) -> tuple[fmpq, ...]:
    """Upper triangle of the matrix of `proper_edge`."""
    side = information_side(d, is_point)
    rows = symmetric(triangle, side)
    if is_semidefinite(rows):
        return triangle
    for a in range(side):
        rows[a][a] += ROUNDED_ENTRIES * rows[a][a]
    if not is_semidefinite(rows):
        raise StepFailedError("the weights: an information matrix is indefinite")
    return tuple(rows[a][b] for a in range(side) for b in range(a, side))


def translation_weight(edge: Edge, splits: Sequence[Split]) -> Weight:
    """The weight of an edge, of the first split that fits it, else of its own choice."""
    d = edge.tag.d
    num_axes = edge.tag.side - d
    for split in splits:
        tau = exact(split.tau)
        J_ss = tuple(map(exact, split.J_ss)) or (fmpq(0),) * (num_axes * (num_axes + 1) // 2)
        D = tuple(map(exact, split.D)) or (fmpq(0),) * d
        if any(D) and not can_weigh_axes(edge):
            continue
        if fits(edge.triangle, d, edge.tag.is_point, tau, J_ss, D):
            block = fmpq_mat(symmetric(J_ss, num_axes)) if J_ss else fmpq_mat(0, 0)
            return Weight(tau, block, D)
    tau = own_translation_weight(edge.triangle, d, edge.tag.is_point)
    translation = range(d)
    axes = range(d, edge.tag.side)
    I_tr = edge.block(translation, axes)
    if not any(I_tr.entries()):
        return Weight(tau, fmpq_mat(num_axes, num_axes))
    if tau == 0:
        # J is the matrix of the file: all of the edge is in the tangent.
        return Weight(tau, edge.block(axes, axes))
    I_tt = edge.block(translation, translation)
    I_tt_less_tau = fmpq_mat(less_tau(I_tt.tolist(), tau, d))
    return Weight(tau, I_tr.transpose() * I_tt_less_tau.inv() * I_tr)


def can_weigh_axes(edge: Edge) -> bool:
    """Whether r of an edge has the axes of the world: it begins there and does not turn."""
    d = edge.tag.d
    differences = (edge.R - identity(d)).entries()
    # A ball == 0 only where it is exactly zero.
    return edge.i == WORLD and all(entry == 0 for entry in differences)


@lru_cache(maxsize=KEPT)
def fits(
    triangle: tuple[fmpq, ...],
    d: int,
    is_point: bool,
    tau: fmpq,
    J_ss: tuple[fmpq, ...],
    D: tuple[fmpq, ...],
) -> bool:
    """Whether J - diag(D, 0), with J of tau and J_ss, is positive semidefinite, exactly.

    J_ss is an upper triangle. D, (d), has to be zero or more.
    """
    side = information_side(d, is_point)
    if len(J_ss) != (side - d) * (side - d + 1) // 2 or not all(number >= 0 for number in D):
        return False
    J = less_tau(symmetric(triangle, side), tau, d)
    for a, number in enumerate(D):
        J[a][a] -= number
    if J_ss:
        for a, row in enumerate(symmetric(J_ss, side - d), d):
            J[a][d:] = row
    return is_semidefinite(J)


@lru_cache(maxsize=KEPT)
def own_translation_weight(triangle: tuple[fmpq, ...], d: int, is_point: bool) -> fmpq:
    """A tau for any edge: I_tt where that is isotropic and not coupled, else as large as it may be.

    What it may be is below the largest tau with I - blockdiag(tau I, 0) positive definite, which
    keeps the term with W_R convex. A coupled I that is only semidefinite leaves no such tau: there
    it is a small share of the smallest eigenvalue of I_tt, and W_R a little indefinite, of which
    the proof asks nothing. It is zero where I_tt does not measure every direction.
    """
    rows = symmetric(triangle, information_side(d, is_point))
    I_tt = [row[:d] for row in rows[:d]]
    I_tr = [row[d:] for row in rows[:d]]
    tau: fmpq | None
    if is_nonzero(I_tr):
        tau = definite_tau(rows, d, COUPLED_SHARE)
        if tau is None:
            tau = definite_tau(I_tt, d, SINGULAR_SHARE)
    else:
        first_entry = I_tt[0][0]
        is_isotropic = not is_nonzero(less_tau(I_tt, first_entry, d))
        tau = first_entry if is_isotropic else definite_tau(I_tt, d, BELOW)
    if tau is None and first_bad_pivot(I_tt) is None:
        raise StepFailedError("the weights: an information matrix is all but singular")
    return fmpq(0) if tau is None else tau


def definite_tau(rows: list[list[fmpq]], d: int, share: float) -> fmpq | None:
    """A share of the largest tau with I - blockdiag(tau I, 0) positive definite, shown to be one.

    It is sought by bisection in doubles, and what comes of it is checked exactly; None where that
    fails, as it does of a singular matrix.
    """
    doubles = [[float(arb(x)) for x in row] for row in rows]
    low = 0.0
    high = min(doubles[a][a] for a in range(d))
    while high - low > RESOLUTION * high:
        middle = 0.5 * (low + high)
        guess = less_tau(doubles, middle, d)
        if first_bad_pivot(guess) is None:
            low = middle
        else:
            high = middle
    tau = exact(share * low)
    if not tau > 0:
        return None
    is_definite = first_bad_pivot(less_tau(rows, tau, d)) is None
    return tau if is_definite else None


def less_tau(rows: list[list[Number]], tau: Number, d: int) -> list[list[Number]]:
    """A matrix less tau on the first d places of its diagonal."""
    smaller = [list(row) for row in rows]
    for a in range(d):
        smaller[a][a] -= tau
    return smaller


def inner(A: arb_mat, B: arb_mat) -> arb:
    """<A, B> = tr(A^T B)."""
    return (A.transpose() * B).trace()


def rotation_weight(I_rr: arb_mat, d: int) -> arb_mat:
    """W_R with tr(W_R (2 I - E - E^T)) = 2 (1 - cos theta) a^T I_rr a."""
    half_trace = I_rr.trace() / 2
    if d == 2:
        return identity(2) * half_trace
    return identity(3) * half_trace - I_rr


def axis_times_sine(E: arb_mat) -> arb_mat:
    """Return a sin theta of a rotation E by theta about a."""
    planes = [(1, 0)] if E.nrows() == 2 else [(2, 1), (0, 2), (1, 0)]
    entries = [(E[a, b] - E[b, a]) / 2 for a, b in planes]
    return arb_mat([[entry] for entry in entries])


def skew(w: arb_mat) -> arb_mat:
    """Return the matrix with <skew(w), E> = 2 <w, axis_times_sine(E)>."""
    if w.nrows() == 1:
        angle = w[0, 0]
        return arb_mat([[0, -angle], [angle, 0]])
    x, y, z = w.entries()
    return arb_mat([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def axis_times_versine(E: arb_mat) -> arb_mat:
    """(1 - cos theta) a a^T of a rotation E by theta about a; in the plane 1 - cos theta."""
    D = E - identity(E.nrows())
    half_trace = D.trace() / 2
    if E.nrows() == 2:
        return arb_mat([[-half_trace]])
    symmetric_part = (D + D.transpose()) * arb(0.5)
    return symmetric_part - identity(3) * half_trace


def versine_adjoint(N: arb_mat, d: int) -> arb_mat:
    """Return the matrix with <versine_adjoint(N), E - I> = <N, axis_times_versine(E)>, N = N^T."""
    half_trace = N.trace() / 2
    if d == 2:
        return -half_trace * identity(2)
    return N - identity(3) * half_trace
