"""Verify the proof of a lower bound without trusting whoever wrote it, in ball arithmetic.

**The problem** is the one that the decimal numbers of a g2o file state. Pose i has the rows
X_i = (t_i^T; R_i^T), R_i a rotation, and a landmark the row t_i^T alone; X stacks them all. The
cost is F, a weighted sum of squared residuals with two weights for an edge, or chi2 with the
information matrices of the file (`pgo_models.verification.costs` has both formulas). Neither
changes if all poses and landmarks are moved together.

X' are the poses and landmarks of the proof, all moved together so that one pose r is at (0, I).
With a symmetric matrix M and a constant that depend on the cost and, for chi2, on X',

    cost(X) >= tr(X^T M X) + constant   for all poses X,

and both sides are equal at X = X'. F is itself such a quadratic form, equal everywhere; chi2 is
not, and its quadratic form is a tangent at X' that is nowhere above it. A common shift of all t_i
does not change the right side.

**The theorem.** Let Lambda_i be any symmetric matrices, and eta >= 0. As R_i^T R_i = I, the right
side is

    q(X) = tr(X^T S X) + tr(Lambda) + constant,   S = M - blockdiag(0, Lambda_i).

Let G = S X'. An index r on S, G and Z means that pose r is left out: S_r is S without the rows and
columns of pose r, and G_r is G without its rows. If H = S_r + eta blockdiag(0, I) is positive
definite, then for all poses X

    (A)   cost(X) >= q(X') - tr(G_r^T H^-1 G_r) - 8 eta (number of rotations - 1).

Proof. Shift X so that its pose r is at the origin, which does not change q(X). Let the rotation V
be the transpose of its R there; then X and X' V have the same rows of pose r, so that Z = X - X' V
is zero there. As V V^T = I, q(X' V) = q(X'), and

    q(X) = q(X') + 2 tr((G_r V)^T Z_r) + tr(Z_r^T S_r Z_r)
         = q(X') + 2 tr((G_r V)^T Z_r) + tr(Z_r^T H Z_r) - eta sum_i ||R_i^T - P_i V||_F^2,

where P_i is the rotation block of X'_i, and the sum is over all rotations but that of pose r. Two
rotations are at most sqrt(8) apart, so that the sum is at most 8 (number of rotations - 1). The
terms before it complete the square

    tr((Z_r + H^-1 G_r V)^T H (Z_r + H^-1 G_r V)) - tr((G_r V)^T H^-1 G_r V),

whose first term is not negative; the second is tr(G_r^T H^-1 G_r), as V cancels in the trace.

With Lambda_i - eta I in place of Lambda_i, S becomes S + eta blockdiag(0, I), and G becomes G' =
G + eta blockdiag(0, I) X', while q(X') stays, for the P_i are rotations. The matrix without pose r
is H again, and (A) with zero in place of eta is

    (B)   cost(X) >= q(X') - tr(G'_r^T H^-1 G'_r).

The larger of the two is taken. (For comparison with the literature alone: where all of
S + eta blockdiag(0, I) is positive semidefinite, (B) is at least tr(Lambda) + constant - eta n d
with n rotations, the bound of weak duality in Rosen et al. 2019.)

**Rotations alone.** Where no edge has a weight for its translation, the cost and q depend on the
rows R_i^T alone. Then the rows t_i^T are left out of S, G and Z as those of pose r are, and the
proof is the same without the shift of X.

**Parts that nothing places.** Where no edge measures translations between two parts of the map, as
with a compass and no position, a common shift of one part does not change the right side either. So
one pose of it may be shifted to where X' V has it, and the row of Z of its translation is zero: it
is left out, too.

**Shifts that are held.** Where the priors leave an axis of the world out, as positions without
height do, all poses but the world may be shifted along it, and the cost stays. So a prior may be
given information along this axis: of all the shifts there is one at which the added term is zero,
so that a bound on the sum is one on the cost (`with_shift_held`).

**The world pose.** Priors measure from it, and where it stands is a matter of names: with another
point o of its frame in its place, t_w + R_w o is the unknown, and positions p in its frame become
p - o, which leaves every residual t_j - t_w - R_w p as it is. Where a proof has the world pose
unturned, it is moved to zero (`with_world_at_zero`). If priors are far away, as in UTM coordinates,
the multiplier of a stationary point then has no lever of their length.

**Handedness terms.** In three dimensions a proof may take terms off q that are never negative on
rotations, so that the smaller form bounds the cost as well. For poses i and j, a rotation T and a
positive semidefinite P, let delta = R_j^T - T^T R_i^T and W = (tr(P) / 2 I - P) / 4. Where the
rotation E = T^T R_i^T R_j has the unit quaternion (w, v), Rodrigues' formula gives
tr(delta^T W delta) = tr(W (2 I - E - E^T)) = v^T P v >= 0. A reflection is no such E: that is what
these terms know, and S does not.

**A matrix for every axis.** If the world pose is the one that is left out, V is the identity, for X
has been moved so that this pose is at (0, I), and the columns of X are coordinates along the axes
of the world. Then q may have other terms in every column k: the squares of
`pgo_models.verification.costs` with the weights D_k, which are zero at X' together with their
gradient; and with any numbers gamma_ik the terms gamma_ik (1 - |p_ik|^2), p_ik column k of P_i,
which are zero for rotations, as their rows have length one. So H_k = H + diag(D_k) - diag(0,
gamma_ik I) and column k of G, less gamma_ik p_ik in its rows of rotations, take the place of H and
G, and the losses to the columns add up. (A) and (B) stay as they are.

**Complex numbers.** In the plane a proof may ask less of H. Rotations are matrices (a, b; -b, a),
and so are products, sums and transposes of such matrices. Thus all blocks of X, of X' V and of Z
have this form, and the steps from Z to (A) and (B) hold if H is positive on such Z alone. Let the
numbers z of a pose be t_0, t_1, a and b, so that its rows of Z have the columns

    (t_0; a; -b)  and  (t_1; b; a),    Z_c = U_c z for the column c = 0, 1.

With H_z = sum_c U_c^T H U_c and g = sum_c U_c^T G_c, tr(Z^T H Z) = z^T H_z z and tr(G^T Z) = g^T z.
V turns all pairs (t_0, t_1) and (a, b) of z by one angle, and as tr((Z V)^T H Z V) = tr(Z^T H Z),
H_z does not change if it is turned: V cancels again. So the theorem holds with H_z > 0 in place of
H > 0, and g_r^T H_z^-1 g_r in place of tr(G_r^T H^-1 G_r).

**The arithmetic.** Numbers of the file are rational numbers. What is computed from them is a ball:
a number with a bound on its error, by Arb through python-flint. A comparison of balls is True only
if it holds for all numbers in them; where they overlap, a <= b and a > b are both False. So what is
to be shown is written as `if not a <= b: fail`, which also fails where nothing is decided. The
square is completed pose by pose (`eliminate`), which is a block LDL^T: H is positive definite if
and only if all pivots are. Doubles serve to guess a weight, which is then checked exactly
(`pgo_models.verification.costs.definite_tau`), and for nothing else.

Nothing in a proof is believed: other poses or multipliers give another bound, which holds as well.
A proof is verified if the bound that it claims is not above the one that is proven here, without
any tolerance. That the poses cost what it claims is checked to what doubles can tell
(`pgo_models.verification.doubles`). Where balls are too wide to decide, all is computed again with
more bits.

Nothing outside `pgo_models.verification` is imported but `pgo_models.errors`.
"""

from dataclasses import replace
from heapq import heapify, heappop, heappush
from pathlib import Path

from pgo_models.errors import SettingError
from pgo_models.verification.balls import (
    above,
    arb,
    arb_mat,
    beside,
    blocks_on_diagonal,
    ctx,
    diagonal,
    exact,
    first_bad_pivot,
    fmpq,
    identity,
    is_semidefinite,
    part,
    symmetric,
)
from pgo_models.verification.costs import (
    QuadraticForm,
    StepFailedError,
    UndecidedError,
    add_edge,
    measures_translation,
    proper_edge,
)
from pgo_models.verification.doubles import Resolution
from pgo_models.verification.measurements import WORLD, Edge, Graph, read_graph
from pgo_models.verification.proof import (
    ROTATION_COSTS,
    HandednessTerm,
    Proof,
    Split,
    read_proof,
)
from pgo_models.verification.robot_logs import SUFFIX as LOG_SUFFIX, read_robot_log
from pgo_models.verification.verification import DIGITS, Verification
from pgo_models.verification.verify_model import verify_model

# Bits; the next where a ball is too wide to decide. With the last ones every pivot that is not zero
# to 2,400 digits has a sign, and a proof that needs more is not one of doubles.
PRECISIONS = (128, 512, 2048, 8192)
# Relative tolerance between the cost that a proof claims for its poses and the exact one, beside
# what doubles cannot tell. The bound has none.
CLAIM_SLACK = 1e-9
FARTHEST = 8  # the largest squared Frobenius norm of the difference of two rotations
NO_ROTATION = 1e-6  # entries that far from those of the rotation made of them are a mistake


def verify_proof(
    graph: Path | str,
    proof: Path | str | None = None,
    *,
    skip_unknown: bool = False,
) -> Verification:
    """Check the proof of a lower bound, as `save_proof` writes it, for the numbers of a file.

    The proof of a cvxpy model has the numbers of the model, and is given alone. Whether these are
    those of a model is for its owner to say: `problem.get_problem_data(cvxpy.CLARABEL)` has them.
    A bound by hulls is of those with `solver_opts={"use_quad_obj": False}`.

    Parameters
    ----------
    graph : Path or str
        The g2o file, or JSON robot log (JRL). Covariance matrices are inverted exactly. Or the
        proof of a model.
    proof : Path, str or None
        The proof of a graph, JSON: cost, poses with their multipliers, the pose that is grounded,
        and eta.
    skip_unknown : bool
        Whether lines with unknown tags are left out, as they were for the solve.

    Returns
    -------
    Verification
        Cost of the poses, lower bound and gap as balls, and which step failed if one did.

    Raises
    ------
    FileFormatError
        When a file cannot be read, or is not what it has to be.
    MissingExtraError
        When python-flint is not installed, which the extra `verify` brings.

    Examples
    --------
    >>> import tempfile
    >>> from pgo_models import PGOProblem, load, save_proof
    >>> from pgo_models.graphs.datasets import locate
    >>> from solvers import solve
    >>> problem, path = PGOProblem(load("grid")), Path(tempfile.mkdtemp()) / "proof.json"
    >>> save_proof(problem, solve(problem).certificate, path)
    >>> found = verify_proof(locate("grid"), path)
    >>> found.is_verified, found.bound.str(10, radius=False)
    (True, '97.01402085')
    """
    paths = {"graph": graph} if proof is None else {"graph": graph, "proof": proof}
    for name, given_path in paths.items():
        # Not by `door`, which imports another room.
        if not isinstance(given_path, str | Path):
            raise SettingError(f"{name} is {given_path!r:.60}; give the path of a file")
    if not isinstance(skip_unknown, bool):
        raise SettingError(f"skip_unknown is {skip_unknown!r:.60}; give True or False")
    path = Path(graph)
    if proof is None:
        return verify_model(path)
    read = read_robot_log if path.suffix == LOG_SUFFIX else read_graph
    measured = read(path, skip_unknown)
    given = read_proof(Path(proof), measured.d)
    measured, given = with_world_at_zero(measured, given)
    if given.held is not None:
        try:
            measured = with_shift_held(measured, *given.held)
        except StepFailedError as failed:
            return Verification(str(graph), given.cost, failure=str(failed))
    name = f"{graph}: {len(measured.nodes)} nodes, {len(measured.edges)} edges, {measured.d}D"
    failure = ""
    before = ctx.prec
    try:
        for bits in PRECISIONS:
            ctx.prec = bits
            try:
                return prove(measured, given, name)
            except UndecidedError as undecided:
                failure = f"{undecided}, with {bits} bits"
            except StepFailedError as failed:
                return Verification(name, given.cost, failure=str(failed))
        return Verification(name, given.cost, failure=failure)
    finally:
        ctx.prec = before


def prove(graph: Graph, proof: Proof, name: str) -> Verification:
    """Cost of the poses and the bound of the theorem; a StepFailedError where it does not apply."""
    X = grounded_poses(graph, proof)
    form = QuadraticForm()
    resolution = Resolution(proof.cost)
    objective = arb(0)
    for edge, splits in zip(graph.edges, splits_of_edges(graph, proof), strict=True):
        try:
            objective += add_edge(form, edge, proof.cost, X, splits)
        except StepFailedError as failed:
            raise type(failed)(f"{failed} (line {edge.line})") from failed
        resolution.add_edge(edge, X)
    # The cost is a sum of squares, with weights that are not negative. A proof without eta claims
    # nothing beyond that.
    bound = arb(0)
    if proof.eta is not None:
        bound = lower_bound(graph, proof, form, X, objective).max(bound)
    gap = (objective - bound) / objective if objective > 0 else None
    num_raised = 0
    if proof.cost == "chi2":
        num_raised = sum(proper_edge(edge) is not edge for edge in graph.edges)
    failure = broken_claim(proof, objective, resolution.of(objective), bound)
    return Verification(name, proof.cost, objective, bound, gap, failure, num_raised)


def splits_of_edges(graph: Graph, proof: Proof) -> list[list[Split]]:
    """The splits to try for every edge, in this order.

    The k-th edge between two poses begins with their k-th split. The others are tried as well, for
    a file that is written anew may have its lines in another order.
    """
    counts: dict[tuple[int, int], int] = {}
    splits_of_edges = []
    for edge in graph.edges:
        ends = edge.i, edge.j
        k = counts.get(ends, 0)
        counts[ends] = k + 1
        splits = proof.splits.get(ends, [])
        splits_of_edges.append(splits[k:] + splits[:k])
    return splits_of_edges


def lower_bound(
    graph: Graph,
    proof: Proof,
    form: QuadraticForm,
    X: dict[int, arb_mat],
    objective: arb,
) -> arb:
    """The larger bound of the theorem; `form` is used up.

    The form comes as tr(X^T M X) + constant. Its matrix is changed in place, to S and then to
    S + eta blockdiag(0, I), which without pose r is H.
    """
    d = graph.d
    rotations = [node for node in X if node not in graph.landmarks]
    eta = arb(proof.eta)
    G = subtract_multipliers(proof, form, X, rotations)
    value_at_X = form.constant + sum((X[node].transpose() * G[node]).trace() for node in X)
    # This comparison finds no fault with a proof, whatever is in it.
    if not value_at_X.overlaps(objective):
        both = f"{value_at_X.str(DIGITS)} and {objective.str(DIGITS)}"
        raise StepFailedError(f"the cost: q(X') is not cost(X'), {both}: a defect of pgo verify")
    value_at_X -= subtract_terms(proof, form, G, X)
    # Right-hand sides G and G' side by side, so that one elimination serves both bounds.
    right_sides = {node: beside(block, block) for node, block in G.items()}
    eta_block = blocks_on_diagonal(arb_mat(1, 1), identity(d) * eta)
    for pose in rotations:
        form.S[pose][pose] += eta_block
        right_sides[pose] += beside(arb_mat(d + 1, d), eta_block * X[pose])
    del right_sides[proof.ground]
    H = without_pose(form.S, proof.ground)
    if form.D or proof.gamma:
        losses = [
            losses_to_G(graph, proof, *along_axis(proof, form.D, H, right_sides, X, axis))
            for axis in range(d)
        ]
        loss_to_G, loss_to_shifted_G = (
            sum(of_axes, arb(0)) for of_axes in zip(*losses, strict=True)
        )
    else:
        loss_to_G, loss_to_shifted_G = losses_to_G(graph, proof, H, right_sides)
    bound_A = value_at_X - loss_to_G - FARTHEST * eta * (len(rotations) - 1)
    bound_B = value_at_X - loss_to_shifted_G
    return bound_A.max(bound_B)


def losses_to_G(
    graph: Graph,
    proof: Proof,
    H: dict[int, dict[int, arb_mat]],
    right_sides: dict[int, arb_mat],
) -> tuple[arb, arb]:
    """tr(G_r^T H^-1 G_r) of G and of G', which are the right-hand sides; both are used up."""
    if is_of_rotations(graph, proof):
        H, right_sides = without_translations(H, right_sides)
    else:
        for pose in held_poses(graph, proof.ground):
            without_translation_of(pose, H, right_sides)
    if proof.is_complex:
        H, right_sides = in_complex_numbers(H, right_sides)
    products = eliminate(H, right_sides)
    width = products.ncols() // 2
    columns_of_G = range(width)
    columns_of_shifted_G = range(width, 2 * width)
    loss_to_G = part(products, columns_of_G, columns_of_G).trace()
    return loss_to_G, part(products, columns_of_shifted_G, columns_of_shifted_G).trace()


def along_axis(
    proof: Proof,
    D: dict[int, list[arb]],
    H: dict[int, dict[int, arb_mat]],
    right_sides: dict[int, arb_mat],
    X: dict[int, arb_mat],
    axis: int,
) -> tuple[dict[int, dict[int, arb_mat]], dict[int, arb_mat]]:
    """H_k and the columns of G and G' for an axis k of the world; what is given stays as it is."""
    if proof.ground != WORLD or proof.is_complex:
        raise StepFailedError("the axes: weights along them need the world pose to be grounded")
    d = X[WORLD].ncols()
    H_k = {i: dict(row) for i, row in H.items()}
    columns = {}
    for node, block in right_sides.items():
        rows = range(block.nrows())
        both = (part(block, rows, range(column, column + 1)) for column in (axis, d + axis))
        columns[node] = beside(*both)
        weight = D[node][axis] if node in D else arb(0)
        diagonal_block = diagonal([weight] + [arb(0)] * (len(rows) - 1))
        if node in proof.gamma and node in proof.R:
            gamma = arb(proof.gamma[node][axis])
            of_lengths = blocks_on_diagonal(arb_mat(1, 1), identity(d) * gamma)
            diagonal_block -= of_lengths
            of_pose = of_lengths * part(X[node], rows, range(axis, axis + 1))
            columns[node] -= beside(of_pose, of_pose)
        H_k[node][node] = H_k[node][node] + diagonal_block
    return H_k, columns


def subtract_multipliers(
    proof: Proof, form: QuadraticForm, X: dict[int, arb_mat], rotations: list[int]
) -> dict[int, arb_mat]:
    """G = S X', once M and the constant of the form are changed to S and constant + tr(Lambda)."""
    products = form.product(X)
    for pose in rotations:
        Lambda_i = multipliers(proof, pose, products[pose], X[pose])
        block = blocks_on_diagonal(arb_mat(1, 1), Lambda_i)
        form.S[pose][pose] -= block
        form.constant += block.trace()
        products[pose] -= block * X[pose]
    return products


def subtract_terms(
    proof: Proof, form: QuadraticForm, G: dict[int, arb_mat], X: dict[int, arb_mat]
) -> arb:
    """Take the handedness terms off S and G = S X', and return what they are at X', about zero."""
    terms_at_X = arb(0)
    zero = arb_mat(1, 1)  # translations have no part in them
    for term in proof.terms:
        if not {term.i, term.j} <= proof.R.keys() or term.i == term.j:
            raise StepFailedError("the handedness terms: one is not of two poses with rotations")
        T = exact_rotation(term.T, f"T of {pose_name(term.i)} and {pose_name(term.j)}")
        W = blocks_on_diagonal(zero, weight_of_term(term))
        begin = blocks_on_diagonal(zero, T.transpose())
        delta = blocks_on_diagonal(zero, identity(3)) * X[term.j] - begin * X[term.i]
        form.add(term.i, term.i, -(begin.transpose() * W * begin))
        form.add(term.i, term.j, begin.transpose() * W)
        form.add(term.j, term.j, -W)
        G[term.i] += begin.transpose() * W * delta
        G[term.j] -= W * delta
        terms_at_X += (delta.transpose() * W * delta).trace()
    return terms_at_X


def weight_of_term(term: HandednessTerm) -> arb_mat:
    """(tr(P) / 2 I - P) / 4, once P is shown to be positive semidefinite, exactly."""
    triangle = [exact(number) for number in term.P]
    if not is_semidefinite(symmetric(triangle, 3)):
        raise StepFailedError(
            f"the handedness terms: P of {pose_name(term.i)} and {pose_name(term.j)} "
            "is not positive semidefinite"
        )
    P = arb_mat(symmetric([arb(number) for number in term.P], 3))
    return (identity(3) * (P.trace() / 2) - P) * arb(0.25)


def multipliers(proof: Proof, pose: int, product: arb_mat, X_i: arb_mat) -> arb_mat:
    """Lambda_i of the proof, or else that of a stationary point: sym((M X')_i R_i)."""
    d = X_i.ncols()
    if pose in proof.Lambda:
        triangle = [arb(number) for number in proof.Lambda[pose]]
        return arb_mat(symmetric(triangle, d))
    rotation_rows = range(1, d + 1)
    product_block = part(product, rotation_rows, range(d))
    R_i = part(X_i, rotation_rows, range(d)).transpose()
    block = product_block * R_i
    return (block + block.transpose()) * arb(0.5)


def grounded_poses(graph: Graph, proof: Proof) -> dict[int, arb_mat]:
    """X', the rows of every pose and landmark, moved so that pose r is at (0, I)."""
    check_names(graph, proof)
    r = proof.ground
    t_r = proof.t[r]
    R = {pose: exact_rotation(rows, f"R of {pose_name(pose)}") for pose, rows in proof.R.items()}
    X = {}
    for node, t in proof.t.items():
        difference = [arb(a) - arb(b) for a, b in zip(t, t_r, strict=True)]
        translation = arb_mat([difference]) * R[r]
        X[node] = translation
        if node in R:
            rotation = R[node].transpose() * R[r]
            X[node] = above(translation, rotation)
    X[r] = above(arb_mat(1, graph.d), identity(graph.d))
    return X


def with_world_at_zero(graph: Graph, proof: Proof) -> tuple[Graph, Proof]:
    """Graph and proof with an unturned world pose moved to zero, exactly; others as they are.

    The proof has it at t_w with R_w = I. At its point o = -t_w it stands at t_w + R_w o = 0, and
    its measurements p become p - o = p + t_w.
    """
    d = graph.d
    unturned = [[float(a == b) for b in range(d)] for a in range(d)]
    if proof.R.get(WORLD) != unturned or WORLD not in proof.t:
        return graph, proof
    shift = [fmpq(*number.as_integer_ratio()) for number in proof.t[WORLD]]
    edges = []
    for edge in graph.edges:
        if edge.i == WORLD:
            moved = [p + t for p, t in zip(edge.measured[:d], shift, strict=True)]
            edge = replace(edge, measured=(*moved, *edge.measured[d:]))
        edges.append(edge)
    t = {**proof.t, WORLD: [0.0] * d}
    return replace(graph, edges=edges), replace(proof, t=t)


def check_names(graph: Graph, proof: Proof) -> None:
    """Raise an error unless the proof has the poses and landmarks of the graph, and no others."""
    strangers = sorted(graph.nodes ^ proof.t.keys())
    if strangers:
        raise StepFailedError(f"the poses: {pose_name(strangers[0])} is not in both files")
    if graph.landmarks and is_of_rotations(graph, proof):
        raise StepFailedError("the poses: rotations alone are none of landmarks")
    if proof.R.keys() != graph.nodes - graph.landmarks:
        raise StepFailedError("the poses: a pose has no R, or a landmark has one")
    if proof.ground not in proof.R:
        raise StepFailedError(f"the poses: {pose_name(proof.ground)}, to be grounded, is none")
    if proof.is_complex and is_of_rotations(graph, proof):
        raise StepFailedError("the complex numbers: rotations alone are proven without them")


def exact_rotation(rows: list[list[float]], name: str) -> arb_mat:
    """Ball of a rotation close to a matrix of doubles; an error where the two differ by more.

    Gram-Schmidt makes it of the first d - 1 columns; the last one follows from them, with
    determinant 1.
    """
    d = len(rows)
    given = arb_mat([[arb(entry) for entry in row] for row in rows])
    first = normalized(part(given, range(d), range(1)))
    if d == 2:
        cosine, sine = first.entries()
        rotation = arb_mat([[cosine, -sine], [sine, cosine]])
    else:
        second_column = part(given, range(d), range(1, 2))
        along_first = first * (first.transpose() * second_column)
        second = normalized(second_column - along_first)
        a, b, c = first.entries()
        x, y, z = second.entries()
        cross_product = [b * z - c * y, c * x - a * z, a * y - b * x]
        rotation = arb_mat([[a, b, c], [x, y, z], cross_product]).transpose()
    differences = (rotation - given).entries()
    # Not `any(.. >= NO_ROTATION)`, which is False of balls that are too wide.
    if not all(abs(entry) < NO_ROTATION for entry in differences):
        raise StepFailedError(f"the poses: {name} is no rotation")
    return rotation


def normalized(column: arb_mat) -> arb_mat:
    """A vector over its length."""
    squared_length = (column.transpose() * column)[0, 0]
    return column / squared_length.sqrt()


def without_pose(S: dict[int, dict[int, arb_mat]], r: int) -> dict[int, dict[int, arb_mat]]:
    """S without the rows and columns of pose r."""
    others = {}
    for i, row in S.items():
        if i != r:
            others[i] = {j: block for j, block in row.items() if j != r}
    return others


def is_of_rotations(graph: Graph, proof: Proof) -> bool:
    """Whether the cost is one of rotations alone: no edge has a weight for its translation."""
    if proof.cost in ROTATION_COSTS:
        return True
    return not any(measures_translation(edge) for edge in graph.edges)


def without_translations(
    H: dict[int, dict[int, arb_mat]], right_sides: dict[int, arb_mat]
) -> tuple[dict[int, dict[int, arb_mat]], dict[int, arb_mat]]:
    """H and right-hand sides in the rows of rotations; H has zeros in those of translations."""
    some_block = next(iter(right_sides.values()))
    rows = range(1, some_block.nrows())
    columns = range(some_block.ncols())
    H_of_rotations = {}
    for i, row in H.items():
        H_of_rotations[i] = {j: part(block, rows, rows) for j, block in row.items()}
    of_rotations = {i: part(block, rows, columns) for i, block in right_sides.items()}
    return H_of_rotations, of_rotations


def held_poses(graph: Graph, ground: int) -> list[int]:
    """A pose of every part of the map whose position beside that of the `ground` nothing measures.

    The parts are joined by edges that measure translations.
    """
    part_of = {node: {node} for node in graph.nodes}
    for edge in graph.edges:
        first, second = part_of[edge.i], part_of[edge.j]
        if first is second or not measures_translation(edge):
            continue
        larger, smaller = (first, second) if len(first) >= len(second) else (second, first)
        larger |= smaller
        for node in smaller:
            part_of[node] = larger
    held = []
    seen = [part_of[ground]]
    for node in sorted(graph.nodes - graph.landmarks):
        if not any(part_of[node] is known for known in seen):
            seen.append(part_of[node])
            held.append(node)
    return held


def with_shift_held(graph: Graph, pose: int, weights: list[float]) -> Graph:
    """The graph with information along axes of the world that its priors leave out.

    It is added to a prior of a pose. A StepFailedError where some prior measures a shift along one
    of these axes, or may do so because it is turned.
    """
    axes = [axis for axis, weight in enumerate(weights) if weight != 0.0]
    priors = [edge for edge in graph.edges if WORLD in (edge.i, edge.j)]
    for edge in priors:
        for axis in axes:
            if edge.i != WORLD or not leaves_out(edge, axis):
                raise StepFailedError(
                    f"the shift that is held: the prior of {pose_name(edge.j)} may measure it "
                    f"(line {edge.line})"
                )
    of_pose = [edge for edge in priors if edge.j == pose and keeps_axes(edge, axes)]
    if not of_pose or not all(weight >= 0.0 for weight in weights):
        raise StepFailedError(f"the shift that is held: no prior of {pose_name(pose)} can hold it")
    first = of_pose[0]
    rows = symmetric(first.triangle, first.tag.side)
    for axis in axes:
        rows[axis][axis] += exact(weights[axis])
    triangle = tuple(rows[a][b] for a in range(len(rows)) for b in range(a, len(rows)))
    completed = replace(first, triangle=triangle)
    return replace(graph, edges=[completed if edge is first else edge for edge in graph.edges])


def leaves_out(edge: Edge, axis: int) -> bool:
    """Whether a prior says nothing of a shift of the map along an axis of the world."""
    d = edge.tag.d
    rows = symmetric(edge.triangle, edge.tag.side)[:d]
    has_position = any(number != 0 for row in rows for number in row)
    leaves_axis = not any(number != 0 for number in rows[axis])
    return not has_position or (leaves_axis and keeps_axes(edge, [axis]))


def keeps_axes(edge: Edge, axes: list[int]) -> bool:
    """Whether axes of the world are those of the measured pose, which is turned about them alone.

    In the plane and with the angles of TORO the pose must not be turned at all.
    """
    d = edge.tag.d
    if edge.tag.is_point:
        return True
    turn = edge.measured[d:]
    is_quaternion = d == 3 and not edge.tag.is_toro
    others = [
        number for k, number in enumerate(turn[: 2 * d - 3]) if not (is_quaternion and axes == [k])
    ]
    return not any(number != 0 for number in others)


def without_translation_of(
    pose: int, H: dict[int, dict[int, arb_mat]], right_sides: dict[int, arb_mat]
) -> None:
    """Leave the translation of a pose out of H and the right-hand sides."""
    rows = range(1, right_sides[pose].nrows())
    right_sides[pose] = part(right_sides[pose], rows, range(right_sides[pose].ncols()))
    for other, block in H[pose].items():
        if other != pose:
            without_first_row = part(block, rows, range(block.ncols()))
            H[pose][other] = without_first_row
            H[other][pose] = without_first_row.transpose()
    H[pose][pose] = part(H[pose][pose], rows, rows)


def in_complex_numbers(
    H: dict[int, dict[int, arb_mat]], right_sides: dict[int, arb_mat]
) -> tuple[dict[int, dict[int, arb_mat]], dict[int, arb_mat]]:
    """H_z, and the columns g of G and of G', from H and the columns of both side by side."""
    U = {node: columns_of_numbers(block.nrows()) for node, block in right_sides.items()}
    H_z = {}
    columns_g = {}
    for i, row in H.items():
        H_z[i] = {
            j: sum_of_columns(U[i], block * U[j][0], block * U[j][1]) for j, block in row.items()
        }
        rows = range(right_sides[i].nrows())
        G_0, G_1, shifted_0, shifted_1 = (
            part(right_sides[i], rows, range(column, column + 1)) for column in range(4)
        )
        g = sum_of_columns(U[i], G_0, G_1)
        columns_g[i] = beside(g, sum_of_columns(U[i], shifted_0, shifted_1))
    return H_z, columns_g


def sum_of_columns(U: tuple[arb_mat, arb_mat], of_0: arb_mat, of_1: arb_mat) -> arb_mat:
    """U_0^T of_0 + U_1^T of_1."""
    return U[0].transpose() * of_0 + U[1].transpose() * of_1


def columns_of_numbers(num_rows: int) -> tuple[arb_mat, arb_mat]:
    """U_0 and U_1 of a pose, whose rows are three, or of a landmark, which has one.

    A pose whose translation is held has the two rows of its rotation.
    """
    if num_rows == 2:
        return arb_mat([[1, 0], [0, -1]]), arb_mat([[0, 1], [1, 0]])
    U_0 = [[1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, -1]]
    U_1 = [[0, 1, 0, 0], [0, 0, 0, 1], [0, 0, 1, 0]]
    size = 4 if num_rows == 3 else 2
    return (
        arb_mat([row[:size] for row in U_0[:num_rows]]),
        arb_mat([row[:size] for row in U_1[:num_rows]]),
    )


def eliminate(H: dict[int, dict[int, arb_mat]], G: dict[int, arb_mat]) -> arb_mat:
    """G^T H^-1 G, once H is shown to be positive definite; both are used up.

    Minus its trace is the minimum of tr(Z^T H Z) + 2 tr(G^T Z), which is taken over the rows Z_k of
    one pose at a time. The terms with Z_k are

        tr(Z_k^T P Z_k) + 2 tr(Z_k^T C),   P = H_kk,   C = G_k + sum_{i != k} H_ki Z_i.

    If the pivot P is positive definite, their minimum over Z_k, at Z_k = -P^-1 C, is -tr(C^T P^-1
    C). Multiplied out, that is the constant -tr(G_k^T P^-1 G_k), and terms in the other Z_i, which
    change their form to

        H_ij <- H_ij - H_ik P^-1 H_kj,   G_i <- G_i - H_ik P^-1 G_k.

    If P is not positive definite, H is not.

    The next pose is one with the fewest neighbours left, so that few blocks become non-zero. Ties
    go to the smallest depth: the depth of a pose is the length of the longest chain of earlier
    eliminations that its pivot depends on. Every link of such a chain makes the balls wider.
    """
    columns = next(iter(G.values())).ncols()
    total = arb_mat(columns, columns)
    depth = dict.fromkeys(H, 0)
    waiting = [(len(row), 0, k) for k, row in H.items()]
    heapify(waiting)
    while waiting:
        num_blocks, depth_of_k, k = heappop(waiting)
        # An entry is out of date if its pose was eliminated, or is in the heap again with other
        # neighbours or another depth.
        if k not in H or num_blocks != len(H[k]) or depth_of_k != depth[k]:
            continue
        neighbours = H.pop(k)
        G_k = G.pop(k)
        pivot = neighbours.pop(k)
        inverse = inverse_of_definite(pivot, k)
        total += G_k.transpose() * inverse * G_k
        eliminate_pose(H, G, k, neighbours, inverse, G_k)
        for i in neighbours:
            depth[i] = max(depth[i], depth_of_k + 1)
            heappush(waiting, (len(H[i]), depth[i], i))
    return total


def eliminate_pose(
    H: dict[int, dict[int, arb_mat]],
    G: dict[int, arb_mat],
    k: int,
    neighbours: dict[int, arb_mat],
    inverse: arb_mat,
    G_k: arb_mat,
) -> None:
    """Update H_ij and G_i for the elimination of pose k, given the blocks H_ki of its neighbours.

    H stores H_ij and H_ji. Each pair is computed once, when the later of the two neighbours is
    visited; the other block is its transpose.
    """
    visited: list[tuple[int, arb_mat]] = []
    for i, H_ki in neighbours.items():
        row = H[i]
        del row[k]
        visited.append((i, H_ki))
        share = H_ki.transpose() * inverse
        G[i] -= share * G_k
        for j, H_kj in visited:
            update = share * H_kj
            row[j] = row[j] - update if j in row else -update
            if j != i:
                H[j][i] = row[j].transpose()


def inverse_of_definite(pivot: arb_mat, pose: int) -> arb_mat:
    """Inverse of a pivot, once it is shown to be positive definite."""
    check_definite(pivot, pose)
    try:
        return pivot.inv()
    except ZeroDivisionError:
        problem = f"the elimination: a pivot of {pose_name(pose)} is not known well enough"
        raise UndecidedError(problem) from None


def check_definite(pivot: arb_mat, pose: int) -> None:
    """Raise an error unless a pivot is shown to be positive definite."""
    bad = first_bad_pivot(pivot.tolist())
    if bad is None:
        return
    value = f"a pivot of {pose_name(pose)} is {arb(bad).str(5)}"
    # A ball that contains zero is not <= 0: nothing is decided of it.
    if bad <= 0:
        raise StepFailedError(f"the elimination: H is not positive definite, {value}")
    raise UndecidedError(f"the elimination: H is not known to be positive definite, {value}")


def pose_name(pose: int) -> str:
    """Pose with its id, or the world."""
    return "the world" if pose == WORLD else f"pose {pose}"


def broken_claim(proof: Proof, objective: arb, tolerance: arb, bound: arb) -> str:
    """What the proof claims and does not prove, or nothing; an UndecidedError if balls overlap."""
    difference = abs(objective - proof.objective)
    slack = CLAIM_SLACK * objective + tolerance
    claims = (
        (difference, slack, f"the cost of the poses is not {proof.objective!r}"),
        (arb(proof.lower_bound), bound, f"what is proven is less than {proof.lower_bound!r}"),
    )
    for smaller, larger, problem in claims:
        if smaller <= larger:
            continue
        if smaller > larger:
            return f"the claims: {problem}"
        raise UndecidedError(f"the claims: it is not known whether {problem}")
    return ""
