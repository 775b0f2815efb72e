"""Random quadratic models over rotations: the share certified, the other gaps, and CPU seconds.

    python tests/benchmarks/any_model.py [share of the models, 1 unless given]

A model is a sum of 9 m squares, of affine functions of m matrices with N(0, 1) entries: far from
any noise model. `above` counts bounds above the least J of many starts, which have to be none.
"""

import sys
import time

import cvxpy as cp
import numpy as np

import pgo_models as pgo
import solvers

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
COMPARED = 3  # models of a family that are solved with a convex solver in step (a), too


def random_model(seed: int, kind: str, shape: tuple[int, int], count: int) -> pgo.OrthogonalProblem:
    """A sum of as many squares as there are entries."""
    rng = np.random.default_rng(seed)
    variables = [cp.Variable(shape) for _ in range(count)]
    entries = cp.hstack([cp.vec(X, order="F") for X in variables])
    A = rng.standard_normal((entries.size, entries.size))
    squares = cp.sum_squares(A @ entries - rng.standard_normal(entries.size))
    return pgo.OrthogonalProblem(cp.Problem(cp.Minimize(squares)), **{kind: variables})


def cpu_seconds(
    model: pgo.OrthogonalProblem, settings: solvers.OrthogonalSOC | None
) -> tuple[float, object]:
    """CPU seconds of five starts, and the solution."""
    begun = time.process_time()
    solution = solvers.solve_orthogonal(model, 0, settings, starts=STARTS)
    return time.process_time() - begun, solution


def main() -> None:
    """Print a row a family."""
    share = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
    print("| sets | models | certified | other gaps: median, largest | above | CPU s | Clarabel |")
    print("|---|---|---|---|---|---|---|")
    by_solver = solvers.OrthogonalSOC(x_step=solvers.XStep.CONVEX_SOLVER)
    for kind, shape, count, number, starts in FAMILIES:
        gaps = []
        seconds = []
        seconds_of_solver = []
        above = 0
        for seed in range(max(1, round(share * number))):
            model = random_model(seed, kind, shape, count)
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


if __name__ == "__main__":
    main()
