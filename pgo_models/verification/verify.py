"""Verify the proof of a lower bound without trusting whoever wrote it, in ball arithmetic.

**The problem** is the one that the decimal numbers of a g2o file state. Pose i has the rows
X_i = (t_i^T; R_i^T), and a landmark the row t_i^T alone. The cost, F or the file's chi2, is at
least a quadratic form everywhere, and equal to it at the poses X' of the proof (`costs`):

    cost(X) >= tr(X^T M X) + constant   for all poses X.

**The theorem.** Let Lambda_i be any symmetric matrices, and eta >= 0. As R_i^T R_i = I, the right
side is

    q(X) = tr(X^T S X) + tr(Lambda) + constant,   S = M - blockdiag(0, Lambda_i).

Move all poses of X' together, which changes nothing, so that pose r is at (0, I). Let G = S X',
and let S_r and G_r be S and G without the rows of pose r. If H = S_r + eta blockdiag(0, I) is
positive definite, then for all poses X

    cost(X) >= q(X') - tr(G_r^T H^-1 G_r) - 8 eta (number of rotations - 1).

Proof. Shift X, which changes nothing, so that t_r = 0. Let Q be R_r^T of X, and Z = X - X' Q, whose
rows of pose r are zero. Then q(X) = q(X') + 2 tr((G Q)^T Z) + tr(Z^T S Z), and the last term is
tr(Z_r^T H Z_r) - eta sum ||R_i^T - X'_i Q||^2. Two rotations are at most sqrt(8) apart. Completing
the square, the rest is at least q(X') - tr(G_r^T H^-1 G_r).

With Lambda_i - eta I in place of Lambda_i, S becomes S + eta blockdiag(0, I), and G becomes G' =
G + eta blockdiag(0, I) X', while q(X') stays. So the same H proves, without a shift, that

    cost(X) >= q(X') - tr(G'_r^T H^-1 G'_r).

The larger of the two is taken. The second is at least tr(Lambda) + constant - eta n d where all of
S + eta blockdiag(0, I) is positive semidefinite (Rosen et al. 2019, theorem 7).

**The arithmetic.** Numbers of the file are rational numbers. What is computed from them is a ball:
a number with a bound on its error, by Arb through python-flint. If a ball is above zero, so is the
number in it. The square is completed pose by pose (`eliminate`), which is a block LDL^T: H is
positive definite if and only if all pivots are. Nothing in a proof is believed: other poses or
multipliers give another bound, which holds as well. No other room of this project is imported, and
there is no linear algebra in doubles.
"""

from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from pathlib import Path
from typing import Any

from pgo_models.verification.balls import (
    Parts,
    above,
    arb,
    arb_mat,
    ball_of_parts,
    beside,
    blocks_on_diagonal,
    ctx,
    exact_parts,
    first_bad_pivot,
    identity,
    part,
    symmetric,
)
from pgo_models.verification.costs import QuadraticForm, StepFailedError, UndecidedError, add_edge
from pgo_models.verification.measurements import WORLD, Graph, read_graph
from pgo_models.verification.proof import COSTS, Proof, read_proof

PRECISIONS = (128, 512, 2048)  # bits; the next where a ball is too wide to tell its sign
CLAIM_SLACK = 1e-9  # of the cost: what the solver claims is for its doubles, not for the file
FARTHEST = 8  # the largest squared Frobenius norm of the difference of two rotations
NO_ROTATION = 1e-6  # entries that far from those of the rotation beside them are a mistake
DIGITS = 20


@dataclass(frozen=True, eq=False)
class Verification:
    """What a proof proves of a graph: the cost of its poses and a bound on that of all, as balls.

    Parameters
    ----------
    graph : str
        The graph's file.
    cost : str
        Which cost this is, as the proof names it.
    objective : arb, optional
        The cost of the poses. Its upper end is an upper bound on the least cost.
    bound : arb, optional
        The lower end of this ball is a lower bound on the cost of all poses.
    gap : arb, optional
        (objective - bound) / objective.
    failure : str
        The step that failed, and why; empty where the proof is verified.
    """

    graph: str
    cost: str
    objective: arb | None = None
    bound: arb | None = None
    gap: arb | None = None
    failure: str = ""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the balls by their mantissas and exponents, which python-flint does not do."""
        balls = [exact_parts(ball) for ball in (self.objective, self.bound, self.gap)]
        return _unpickled, (self.graph, self.cost, *balls, self.failure)

    @property
    def is_verified(self) -> bool:
        """Whether the bound is proven, and cost and bound are what the proof claims."""
        return not self.failure

    @property
    def cost_name(self) -> str:
        """F or chi2."""
        return "chi2" if self.cost == "chi2" else "F"

    @property
    def verdict(self) -> str:
        """VERIFIED, and what; or FAILED, at which step, and why."""
        if self.failure:
            return f"FAILED at {self.failure}"
        if self.bound == 0:
            return f"VERIFIED: {self.cost_name} is a sum of squares; no better bound is proven"
        return f"VERIFIED: no poses have {self.cost_name} below this lower bound"

    def facts(self) -> list[tuple[str, str]]:
        """Return the facts as they are printed, balls to 20 digits.

        Returns
        -------
        list of (str, str)
            Pairs of a label and a text.
        """
        balls = [(self.cost_name, self.objective), ("lower bound", self.bound), ("gap", self.gap)]
        return [
            ("graph", self.graph),
            ("cost", f"{COSTS[self.cost]}; numbers as the file has them, in decimals"),
            *((label, ball.str(DIGITS)) for label, ball in balls if ball is not None),
            ("verdict", self.verdict),
        ]

    def as_json(self) -> dict[str, object]:
        """Return what `pgo verify --json` prints.

        Returns
        -------
        dict
            Balls are texts.
        """
        balls = {"objective": self.objective, "lower_bound": self.bound, "gap": self.gap}
        return {
            "graph": self.graph,
            "cost": self.cost,
            **{name: None if ball is None else ball.str(DIGITS) for name, ball in balls.items()},
            "verified": self.is_verified,
            "failure": self.failure,
        }

    def __str__(self) -> str:
        return "\n".join(f"{label:<12} {text}" for label, text in self.facts())


def _unpickled(
    graph: str,
    cost: str,
    objective: Parts | None,
    bound: Parts | None,
    gap: Parts | None,
    failure: str,
) -> Verification:
    """Verification that was pickled, its balls from `exact_parts`."""
    balls = ball_of_parts(objective), ball_of_parts(bound), ball_of_parts(gap)
    return Verification(graph, cost, *balls, failure)


def verify_proof(
    graph: Path | str,
    proof: Path | str,
    *,
    skip_unknown: bool = False,
) -> Verification:
    """Check the proof of a lower bound, as `save_proof` writes it, for the numbers of a g2o file.

    Parameters
    ----------
    graph : Path or str
        The g2o file.
    proof : Path or str
        The proof, JSON: cost, poses with their multipliers, the pose that is grounded, and eta.
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
    measured = read_graph(Path(graph), skip_unknown)
    given = read_proof(Path(proof), measured.d)
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
    objective = arb(0)
    for edge in graph.edges:
        try:
            objective += add_edge(form, edge, proof.cost, X)
        except StepFailedError as failed:
            raise StepFailedError(f"{failed} (line {edge.line})") from failed
    bound = arb(0)  # the cost is a sum of squares, with weights that are not negative
    if proof.eta is not None:
        bound = lower_bound(graph, proof, form, X, objective).max(bound)
    gap = (objective - bound) / objective if objective > 0 else None
    failure = broken_claim(proof, objective, bound)
    return Verification(name, proof.cost, objective, bound, gap, failure)


def lower_bound(
    graph: Graph,
    proof: Proof,
    form: QuadraticForm,
    X: dict[int, arb_mat],
    objective: arb,
) -> arb:
    """The larger bound of the theorem."""
    rotations = [node for node in X if node not in graph.landmarks]
    eta = arb(proof.eta)
    # without Lambda so far
    S = form.S
    G = form.product(X)
    for pose in rotations:
        Lambda = blocks_on_diagonal(arb_mat(1, 1), multipliers(proof, pose, G[pose], X[pose]))
        S[pose][pose] -= Lambda
        G[pose] -= Lambda * X[pose]
        form.constant += Lambda.trace()
    value = form.constant + sum((X[node].transpose() * G[node]).trace() for node in X)
    if not value.overlaps(objective):
        both = f"{value.str(DIGITS)} and {objective.str(DIGITS)}"
        raise StepFailedError(f"the cost: q(X') is not cost(X'), {both}: a defect of pgo verify")
    shift = blocks_on_diagonal(arb_mat(1, 1), identity(graph.d) * eta)
    G = {node: beside(block, block) for node, block in G.items()}  # G and G'
    for pose in rotations:
        S[pose][pose] += shift
        G[pose] += beside(arb_mat(graph.d + 1, graph.d), shift * X[pose])
    del G[proof.ground]
    lost = eliminate(without_pose(S, proof.ground), G)
    first = range(graph.d)
    second = range(graph.d, 2 * graph.d)
    shifted = value - part(lost, first, first).trace() - FARTHEST * eta * (len(rotations) - 1)
    return shifted.max(value - part(lost, second, second).trace())


def multipliers(proof: Proof, pose: int, product: arb_mat, X_i: arb_mat) -> arb_mat:
    """Lambda_i of the proof, or else that of a stationary point: sym((M X')_i R_i)."""
    d = X_i.ncols()
    if pose in proof.Lambda:
        return arb_mat(symmetric([arb(number) for number in proof.Lambda[pose]], d))
    rows = range(1, d + 1), range(d)
    found = part(product, *rows) * part(X_i, *rows).transpose()
    return (found + found.transpose()) * arb(0.5)


def grounded_poses(graph: Graph, proof: Proof) -> dict[int, arb_mat]:
    """X', the rows of every pose and landmark, moved so that pose r is at (0, I)."""
    check_names(graph, proof)
    r = proof.ground
    R = {pose: exact_rotation(rows, pose) for pose, rows in proof.R.items()}
    X = {}
    for node, t in proof.t.items():
        shift = [arb(a) - arb(b) for a, b in zip(t, proof.t[r], strict=True)]
        X[node] = arb_mat([shift]) * R[r]
        if node in R:
            X[node] = above(X[node], R[node].transpose() * R[r])
    X[r] = above(arb_mat(1, graph.d), identity(graph.d))
    return X


def check_names(graph: Graph, proof: Proof) -> None:
    """Raise an error unless the proof has the poses and landmarks of the graph, and no others."""
    strangers = sorted(graph.nodes ^ proof.t.keys())
    if strangers:
        raise StepFailedError(f"the poses: {pose_name(strangers[0])} is not in both files")
    if proof.R.keys() != graph.nodes - graph.landmarks:
        raise StepFailedError("the poses: a pose has no R, or a landmark has one")
    if proof.ground not in proof.R:
        raise StepFailedError(f"the poses: {pose_name(proof.ground)}, to be grounded, is none")


def exact_rotation(rows: list[list[float]], pose: int) -> arb_mat:
    """Ball of the rotation that Gram-Schmidt makes of doubles, which are one but for rounding."""
    d = len(rows)
    columns = [arb_mat([[arb(row[k])] for row in rows]) for k in range(d)]
    first = normalized(columns[0])
    if d == 2:
        cosine, sine = first.entries()
        found = arb_mat([[cosine, -sine], [sine, cosine]])
    else:
        second = normalized(columns[1] - first * (first.transpose() * columns[1]))
        (a, b, c), (x, y, z) = first.entries(), second.entries()
        third = [b * z - c * y, c * x - a * z, a * y - b * x]
        found = arb_mat([[a, b, c], [x, y, z], third]).transpose()
    given = arb_mat([[arb(entry) for entry in row] for row in rows])
    if not all(abs(entry) < NO_ROTATION for entry in (found - given).entries()):
        raise StepFailedError(f"the poses: R of {pose_name(pose)} is no rotation")
    return found


def normalized(column: arb_mat) -> arb_mat:
    """A vector over its length."""
    return column / (column.transpose() * column)[0, 0].sqrt()


def without_pose(S: dict[int, dict[int, arb_mat]], r: int) -> dict[int, dict[int, arb_mat]]:
    """S without the rows and columns of pose r."""
    return {i: {j: block for j, block in row.items() if j != r} for i, row in S.items() if i != r}


def eliminate(H: dict[int, dict[int, arb_mat]], G: dict[int, arb_mat]) -> arb_mat:
    """G^T H^-1 G, once H is shown to be positive definite; both are used up.

    Minus its trace is the least value of tr(Z^T H Z) + 2 tr(G^T Z). Terms with Z_k of a pose are

        tr(Z_k^T P Z_k) + 2 tr(Z_k^T V),   P = H_kk,   V = G_k + sum_i H_ki Z_i,

    whose least value is -tr(V^T P^-1 V). So -tr(G_k^T P^-1 G_k) beside the same form is left, with

        H_ij <- H_ij - H_ik P^-1 H_kj,   G_i <- G_i - H_ik P^-1 G_k.

    Next is a pose with the fewest neighbours left, so that few blocks become non-zero; of several
    one that the fewest eliminations led to, one upon the other, as each makes balls wider.
    """
    columns = next(iter(G.values())).ncols()
    found = arb_mat(columns, columns)
    depth = dict.fromkeys(H, 0)
    waiting = [(len(row), 0, k) for k, row in H.items()]
    heapify(waiting)
    while waiting:
        count, level, k = heappop(waiting)
        if k not in H or (count, level) != (len(H[k]), depth[k]):
            continue  # its neighbours have changed: it waits elsewhere, too
        neighbours = H.pop(k)
        pivot = neighbours.pop(k)
        check_definite(pivot, k)
        try:
            inverse = pivot.inv()
            G_k = G.pop(k)
        except ZeroDivisionError:
            problem = f"the elimination: a pivot of {pose_name(k)} is not known well enough"
            raise UndecidedError(problem) from None
        found += G_k.transpose() * inverse * G_k
        done: list[tuple[int, arb_mat]] = []
        for i, H_ki in neighbours.items():
            row = H[i]
            del row[k]
            done.append((i, H_ki))
            share = H_ki.transpose() * inverse
            G[i] -= share * G_k
            for j, H_kj in done:
                update = share * H_kj
                row[j] = row[j] - update if j in row else -update
                if j != i:
                    H[j][i] = row[j].transpose()
        for i in neighbours:
            depth[i] = max(depth[i], depth[k] + 1)
            heappush(waiting, (len(H[i]), depth[i], i))
    return found


def check_definite(pivot: arb_mat, pose: int) -> None:
    """Raise an error unless a pivot is shown to be positive definite."""
    bad = first_bad_pivot(pivot.tolist())
    if bad is None:
        return
    value = f"a pivot of {pose_name(pose)} is {arb(bad).str(5)}"
    if bad <= 0:
        raise StepFailedError(f"the elimination: H is not positive definite, {value}")
    raise UndecidedError(f"the elimination: H is not known to be positive definite, {value}")


def pose_name(pose: int) -> str:
    """Pose with its id, or the world."""
    return "the world" if pose == WORLD else f"pose {pose}"


def broken_claim(proof: Proof, objective: arb, bound: arb) -> str:
    """What the proof claims and does not prove, or nothing."""
    slack = CLAIM_SLACK * arb(proof.objective) + proof.rounding_level
    if not abs(objective - proof.objective) <= slack:
        return f"the claims: the cost of the poses is not {proof.objective!r}"
    if not bound >= proof.lower_bound - slack:
        return f"the claims: what is proven is less than {proof.lower_bound!r}"
    return ""
