"""Quadratic models over rotations in cvxpy: the share certified, the other gaps, and CPU seconds.

    python tests/benchmarks/any_model.py random [share of the models, 1 unless given]
    python tests/benchmarks/any_model.py registration [draws of each size and noise, 5 unless given]
    python tests/benchmarks/any_model.py hand-eye [draws, 5 unless given]
    python tests/benchmarks/any_model.py hulls [draws of each loss, 5 unless given]
    python tests/benchmarks/any_model.py constraints [draws of each kind, 8 unless given]
    python tests/benchmarks/any_model.py speed

A random model is a sum of 9 m squares, of affine functions of m matrices with N(0, 1) entries: far
from any noise model. `above` counts bounds above the least J of many starts, which have to be none.

`registration` fits points to planes with a rotation and a translation, the noise in parts of the
scene's size; `hand-eye` finds X of A X = X B from motions A and B of the hand and the eye.

`hulls` fits ten points to points by losses that are not quadratic, two of the points wrong, and has
the bound by hulls; its proof is written and verified.

`constraints` adds linear constraints to sums of squares of one or two rotations and a translation,
drawn as in `random`.

`speed` runs five starts of five models by SOC with Newton, and by pymanopt's trust regions with the
same starts, with the same matrix for the gradient and the Hessian, to the same gradient. pymanopt
is needed for this alone.
"""

import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cvxpy as cp
import numpy as np

import pgo_models as pgo
import solvers
from pgo_models.convex.orthogonality_examples import procrustes
from pgo_models.convex.quadratic_split import QuadraticSplit
from solvers.convex.model_newton import ModelNewton

sys.path.insert(0, str(Path(__file__).parent.parent))  # of the tests, whose models are used
from orthogonal_models import CONSTRAINTS, constrained, random_squares

try:
    import pymanopt
except ImportError:  # `speed` says so
    pymanopt = None

# kind of set, shape, number of variables, number of models, starts to compare with
FAMILIES = [
    ("rotations", (2, 2), 3, 50, 40),
    ("rotations", (3, 3), 1, 100, 40),
    ("rotations", (3, 3), 2, 50, 40),
    ("rotations", (3, 3), 3, 20, 40),
    ("orthogonal", (3, 3), 1, 50, 40),
    ("orthogonal", (4, 2), 1, 50, 40),
    ("unit_columns", (3, 2), 2, 50, 40),
    ("unit_rows", (6, 3), 1, 50, 40),
]
STARTS = 5
GRADIENT = 1e-8  # at which pymanopt stops; Newton ends at rounding
COMPARED = 3  # models of a family that are solved with a convex solver in step (a), too


def cpu_seconds(
    model: pgo.OrthogonalProblem, settings: solvers.OrthogonalSOC | None
) -> tuple[float, object]:
    """CPU seconds of five starts, and the solution."""
    begun = time.process_time()
    solution = solvers.solve_orthogonal(model, 0, settings, starts=STARTS)
    return time.process_time() - begun, solution


def random_models(share: float = 1.0) -> None:
    """Print a row a family."""
    print("| sets | models | certified | other gaps: median, largest | above | CPU s | Clarabel |")
    print("|---|---|---|---|---|---|---|")
    by_solver = solvers.OrthogonalSOC(solver="CLARABEL")
    for kind, shape, count, number, starts in FAMILIES:
        gaps = []
        seconds = []
        seconds_of_solver = []
        above = 0
        for seed in range(max(1, round(share * number))):
            model = random_squares(seed, kind, shape, count)
            taken, solution = cpu_seconds(model, None)
            seconds.append(taken)
            many = solvers.solve_orthogonal(model, 1, starts=starts)
            above += solution.lower_bound > min(many.objective, solution.objective)
            gaps.append(0.0 if solution.is_certified else solution.gap)
            if seed < COMPARED:
                seconds_of_solver.append(cpu_seconds(model, by_solver)[0])
        others = [gap for gap in gaps if gap > 0.0]
        wide = f"{np.median(others):.2g}, {max(others):.2g}" if others else ""
        certified = f"{len(gaps) - len(others)} of {len(gaps)}"
        sets = f"{kind} {shape[0]} x {shape[1]}, {count}"
        times = f"{np.median(seconds):.2g} | {np.median(seconds_of_solver):.2g}"
        print(f"| {sets} | {len(gaps)} | {certified} | {wide} | {above} | {times} |", flush=True)


SIZES = (3, 4, 5, 7, 10, 30, 100, 1000)
NOISES = (0.01, 0.03, 0.1, 0.3, 1.0)
MOTIONS = (3, 5, 10, 20, 50)
DEGREES = (1.0, 5.0, 20.0, 60.0)


def registration(num_points: int, noise: float, seed: int) -> pgo.OrthogonalProblem:
    """Points to planes: sum over the points of (n_i^T (R p_i + t - q_i))^2."""
    rng = np.random.default_rng(seed)
    points, shifts = rng.standard_normal((2, num_points, 3))
    normals = rng.standard_normal((num_points, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seen = points @ pgo.random_rotations(1, 3, rng)[0].T + noise * shifts
    R, t = cp.Variable((3, 3), name="R"), cp.Variable(3, name="t")
    by_entry = np.einsum("ki,kj->kji", normals, points).reshape(num_points, 9)
    residuals = by_entry @ cp.vec(R, order="F") + normals @ t - np.sum(normals * seen, axis=1)
    return pgo.OrthogonalProblem(cp.Problem(cp.Minimize(cp.sum_squares(residuals))), rotations=[R])


def hand_eye(num_motions: int, degrees: float, seed: int) -> pgo.OrthogonalProblem:
    """A X = X B: rotations R_A R = R R_B, translations R_A t + t_A = R t_B + t."""
    rng = np.random.default_rng(seed)
    X = pgo.random_rotations(1, 3, rng)[0]
    R_B = pgo.random_rotations(num_motions, 3, rng)
    t_X, t_B = rng.standard_normal(3), rng.standard_normal((num_motions, 3))
    R_A = pgo.project_to_rotations(
        X @ R_B @ X.T + np.radians(degrees) * rng.standard_normal(R_B.shape)
    )
    t_A = t_B @ X.T + t_X - R_A @ t_X
    t_A += np.radians(degrees) * rng.standard_normal(t_A.shape)
    R, t = cp.Variable((3, 3), name="R"), cp.Variable(3, name="t")
    terms = []
    for k in range(num_motions):
        terms.append(cp.vec(R_A[k] @ R - R @ R_B[k], order="F"))
        terms.append((R_A[k] - np.eye(3)) @ t + t_A[k] - R @ t_B[k])
    squares = cp.sum_squares(cp.hstack(terms))
    return pgo.OrthogonalProblem(cp.Problem(cp.Minimize(squares)), rotations=[R])


def with_constraints(draws: int) -> None:
    """Print a row a kind of constraint: the share certified, other gaps, bounds above, seconds."""
    print("| constraints | certified | other gaps | above | CPU s |")
    print("|---|---|---|---|---|")
    kinds = [kind for kind in CONSTRAINTS if kind != "nowhere active"]  # as without constraints
    for kind in kinds:
        gaps = []
        seconds = []
        above = 0
        for seed in range(draws):
            taken, solution = cpu_seconds(constrained(kind, seed), None)
            seconds.append(taken)
            if not solution.is_certified:
                gaps.append(f"{solution.gap:.1e}")
            other = solvers.solve_orthogonal(constrained(kind, seed), seed + 1, starts=20)
            above += solution.lower_bound > other.objective * (1.0 + 1e-12)
        certified = f"{draws - len(gaps)} of {draws}"
        cells = kind, certified, ", ".join(gaps), str(above), f"{np.median(seconds):.2g}"
        print(f"| {' | '.join(cells)} |", flush=True)


def certified_shares(
    model: Callable[[int, float, int], pgo.OrthogonalProblem],
    sizes: tuple[int, ...],
    noises: tuple[float, ...],
    draws: int,
) -> None:
    """Print a row a size: of how many draws with each noise the answer is certified."""
    print("| | " + " | ".join(f"{noise:g}" for noise in noises) + " | CPU s |")
    print("|---" * (len(noises) + 2) + "|")
    exceptions = []
    for size in sizes:
        cells = []
        seconds = []
        for noise in noises:
            certified = 0
            for seed in range(draws):
                problem = model(size, noise, seed)
                taken, solution = cpu_seconds(problem, None)
                seconds.append(taken)
                certified += solution.is_certified
                if not solution.is_certified:
                    exceptions.append(f"{size}, {noise:g}, seed {seed}: gap {solution.gap:.2g}")
            cells.append(f"{certified} of {draws}")
        print(f"| {size} | {' | '.join(cells)} | {np.median(seconds):.2g} |", flush=True)
    print("exceptions:", "; ".join(exceptions) or "none")


LOSSES: dict[str, Callable[[cp.Expression], cp.Expression]] = {
    "norms": lambda misfits: cp.sum(cp.norm(misfits, axis=1)),
    "1-norm": lambda misfits: cp.sum(cp.abs(misfits)),
    "Huber": lambda misfits: cp.sum(cp.huber(misfits, 0.1)),
}


def bounds_by_hulls(draws: int) -> None:
    """Print a row a loss."""
    print("| loss | certified | gaps: median, largest | above | verified | CPU s of it | kB |")
    print("|---|---|---|---|---|---|---|")
    path = Path(tempfile.mkdtemp()) / "proof.json"
    for name, loss in LOSSES.items():
        gaps, seconds, sizes = [], [], []
        above = certified = verified = 0
        for seed in range(draws):
            rng = np.random.default_rng(seed)
            R, t = cp.Variable((3, 3)), cp.Variable((1, 3))
            points = rng.standard_normal((10, 3))
            scene = points @ pgo.random_rotations(1, 3, rng)[0].T
            scene += 0.1 * rng.standard_normal(scene.shape)
            scene[:2] += rng.standard_normal((2, 3))
            J = loss(points @ R.T + np.ones((10, 1)) @ t - scene)
            model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J)), rotations=[R])
            solution = solvers.solve_orthogonal(model, 0, starts=2)
            many = solvers.solve_orthogonal(model, 1, starts=6)
            above += solution.lower_bound > min(many.objective, solution.objective)
            certified += solution.is_certified
            gaps.append(solution.gap)
            solution.save_proof(path)
            begun = time.process_time()
            verified += pgo.verify_proof(path).is_verified
            seconds.append(time.process_time() - begun)
            sizes.append(path.stat().st_size / 1e3)
        wide = f"{np.median(gaps):.2g}, {max(gaps):.2g}"
        of_proofs = f"{verified} of {draws} | {np.median(seconds):.2g} | {np.median(sizes):.2g}"
        print(f"| {name} | {certified} of {draws} | {wide} | {above} | {of_proofs} |", flush=True)


def compared_models() -> dict[str, pgo.OrthogonalProblem]:
    """The five models of `speed`."""
    rng = np.random.default_rng(0)
    draw = rng.standard_normal
    models = {
        "Procrustes 5 x 5": procrustes(draw((5, 5)), draw((5, 5))),
        "unbalanced Procrustes 8 x 3": procrustes(draw((10, 8)), draw((10, 3))),
    }
    A, B = draw((2, 6, 6))
    X = cp.Variable((6, 6))
    assignment = cp.sum_squares((A + A.T) @ X - X @ (B + B.T))
    models["orthogonal QAP 6 x 6"] = pgo.OrthogonalProblem(
        cp.Problem(cp.Minimize(assignment)), orthogonal=[X]
    )
    X = cp.Variable((30, 4))
    trace = cp.sum_squares(draw((30, 30)) / 30**0.5 @ X @ np.diag(np.arange(1.0, 5.0) ** 0.5))
    models["Brockett 30 x 4"] = pgo.OrthogonalProblem(
        cp.Problem(cp.Minimize(trace)), orthogonal=[X]
    )
    models["Procrustes 20 x 20"] = procrustes(draw((20, 20)), draw((20, 20)))
    return models


def pymanopt_problem(model: pgo.OrthogonalProblem, form: pgo.QuadraticForm) -> Any:
    """The model for pymanopt, with its gradient and Hessian as one matrix."""
    H = 2.0 * form.Q.toarray()
    shape = model.variables[0].shape
    manifold = pymanopt.manifolds.Stiefel(*shape)

    @pymanopt.function.numpy(manifold)
    def cost(X):
        x = X.reshape(-1, order="F")
        return 0.5 * x @ (H[:-1, :-1] @ x) + H[:-1, -1] @ x + 0.5 * H[-1, -1]

    @pymanopt.function.numpy(manifold)
    def gradient(X):
        return (H[:-1, :-1] @ X.reshape(-1, order="F") + H[:-1, -1]).reshape(shape, order="F")

    @pymanopt.function.numpy(manifold)
    def hessian(X, V):
        return (H[:-1, :-1] @ V.reshape(-1, order="F")).reshape(shape, order="F")

    return pymanopt.Problem(manifold, cost, euclidean_gradient=gradient, euclidean_hessian=hessian)


def speed() -> None:
    """Print CPU seconds of five starts, as found by both, and of a whole solve."""
    if pymanopt is None:
        sys.exit("any_model.py speed needs pymanopt: pip install pymanopt")
    print("| | SOC with Newton | pymanopt | least J | pymanopt's | with the certificate | gap |")
    print("|---|---|---|---|---|---|---|")
    solvers.solve_orthogonal(random_squares(0, "orthogonal", (2, 2), 1))  # imports what it needs
    for name, model in compared_models().items():
        pgo.quadratic_form(model)  # compiles
        rng = np.random.default_rng(1)
        starts = [model.random_point(rng) for _ in range(STARTS)]
        begun = time.process_time()
        split = QuadraticSplit(model, pgo.quadratic_form(model))
        method = solvers.OrthogonalSOC(x_step=split, newton=ModelNewton(split.form))
        outcomes = [solvers.run(method, model, start) for start in starts]
        ours = time.process_time() - begun

        problem = pymanopt_problem(model, split.form)
        optimizer = pymanopt.optimizers.TrustRegions(verbosity=0, min_gradient_norm=GRADIENT)
        begun = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pymanopt's at its own limits of rounding
            theirs = [optimizer.run(problem, initial_point=start.copies[0]) for start in starts]
        seconds = time.process_time() - begun
        least = min(outcome.objective for outcome in outcomes)
        least_of_theirs = min(result.cost for result in theirs)
        taken, solution = cpu_seconds(model, None)
        print(
            f"| {name} | {ours:.3f} | {seconds:.3f} | {least:.9g} | {least_of_theirs:.9g} "
            f"| {taken:.2g} | {solution.gap:.2g} |",
            flush=True,
        )


def main() -> None:
    """Print the tables that are asked for."""
    what = sys.argv[1] if len(sys.argv) > 1 else "random"
    number = sys.argv[2] if len(sys.argv) > 2 else None
    if what == "random":
        random_models(float(number or 1.0))
    elif what == "registration":
        certified_shares(registration, SIZES, NOISES, int(number or 5))
    elif what == "hand-eye":
        certified_shares(hand_eye, MOTIONS, DEGREES, int(number or 5))
    elif what == "hulls":
        bounds_by_hulls(int(number or 5))
    elif what == "constraints":
        with_constraints(int(number or 8))
    elif what == "speed":
        speed()
    else:
        kinds = "random, registration, hand-eye, hulls, constraints, speed"
        sys.exit(f"any_model.py: {what!r} is none of {kinds}")


if __name__ == "__main__":
    main()
