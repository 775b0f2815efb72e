"""Which form of the semidefinite relaxation to pose, and which solver to give it: by the sizes of the cliques."""

import enum
from dataclasses import dataclass

import numpy as np

from pgo_models.convex.convex_solver import ConvexSolver, as_solver
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.problem.problem import PGOProblem
from pgo_models.relaxations.clique_tree import CliqueTree, build_clique_tree, clique_side

DEFAULT_MEMORY_LIMIT = 4e9  # bytes
CLARABEL = ConvexSolver()  # interior point, accurate; its work grows with the sixth power of a cone's side
SCS = ConvexSolver("SCS")  # first order, rougher; with the third power

# Measured on one core (tests/benchmarks/test_relaxations_benchmark.py). Clarabel factors a dense matrix of the order of
# every cone's triangle at every iteration, about 15 of them; SCS takes an eigendecomposition of each, about 1000 times.
_CLARABEL_ITERATIONS, _CLARABEL_RATE = 15, 2e10
_SCS_ITERATIONS, _SCS_RATE = 1000, 2e9
_PATIENCE = 2.0  # seconds: up to here the interior point is preferred for its accuracy
_CLARABEL_BYTES = 56.0  # for every entry of those dense matrices: matrix and factor
_SCS_BYTES = 400.0  # for every entry of a cone's triangle: constraint matrices, work vectors, cvxpy's copies
_DENSE_BYTES = 64.0  # for every entry of a dense matrix of the model
_CONE_BYTES = 1.2e5  # of cvxpy's for every cone


class RelaxationForm(enum.Enum):
    """How the relaxation is posed."""

    PRIMAL = "min tr(Q Z), Z_ii = I, Z PSD: one dense cone, translations marginalised out"
    DUAL = "max tr(Lambda), M - blockdiag(0, Lambda) PSD: one sparse linear matrix inequality"
    CLIQUES = "one small cone for every clique of a chordal extension"


@dataclass(frozen=True, eq=False)
class RelaxationPlan:
    """A form and a solver, what they will take, and why they were chosen."""

    form: RelaxationForm
    solver: ConvexSolver
    tree: CliqueTree
    seconds: float  # rough estimate
    memory: float  # estimate in bytes
    reason: str

    def __str__(self) -> str:
        return f"{self.form.name} with {self.solver.name}, about {_bytes(self.memory)}: {self.reason}"


def plan_relaxation(
    problem: PGOProblem,
    form: RelaxationForm | None = None,
    solver: ConvexSolver | str | None = None,
    memory_limit: float = DEFAULT_MEMORY_LIMIT,
) -> RelaxationPlan:
    """Choose what is not given: the cliques with Clarabel where they are small, else the dense primal with SCS.

    Forms nothing larger than the clique tree. A SettingError when `memory_limit`, bytes, is exceeded or not positive.
    """
    if not memory_limit > 0:
        raise SettingError(f"memory_limit is {memory_limit}; give positive bytes")
    tree = build_clique_tree(problem.graph)
    largest = int(clique_side(int(tree.sizes.max()), problem.d))
    dense_side = problem.d * problem.num_poses
    shape = f"the largest of {len(tree.cliques)} cliques has side {largest}, the dense cone {dense_side}"
    if form is None and solver is None:
        small = _seconds(problem, tree, RelaxationForm.CLIQUES, CLARABEL)
        dense = _seconds(problem, tree, RelaxationForm.PRIMAL, SCS)
        is_small = small <= max(_PATIENCE, dense)
        form, chosen = (RelaxationForm.CLIQUES, CLARABEL) if is_small else (RelaxationForm.PRIMAL, SCS)
        reason = f"{shape}; estimated {small:.2g} s for the cliques with Clarabel, {dense:.2g} s dense with SCS"
    else:
        chosen = as_solver(solver or (SCS if form is RelaxationForm.PRIMAL else CLARABEL))
        asked = [*([] if form is None else [form.name]), *([] if solver is None else [chosen.name])]
        form = form or (RelaxationForm.PRIMAL if chosen.is_first_order else RelaxationForm.CLIQUES)
        reason = f"{' and '.join(asked)} as asked for; {shape}"
    memory = _memory(problem, tree, form, chosen)
    if memory > memory_limit:
        needs = f"needs about {_bytes(memory)}, above the limit of {_bytes(memory_limit)} ({reason})"
        way_out = "use certify(problem, poses), which proves the same bound by one factorisation, or raise memory_limit"
        raise SettingError(f"the relaxation of {problem!r} as {form.name} with {chosen.name} {needs}; {way_out}")
    return RelaxationPlan(form, chosen, tree, _seconds(problem, tree, form, chosen), memory, reason)


def _sides(problem: PGOProblem, tree: CliqueTree, form: RelaxationForm) -> Array:
    if form is RelaxationForm.PRIMAL:
        return np.array([float(problem.d * problem.num_poses)])
    if form is RelaxationForm.CLIQUES:
        return np.asarray(clique_side(1, problem.d) + (problem.d + 1.0) * (tree.sizes - 1))
    return np.asarray((problem.d + 1.0) * tree.sizes)  # as Clarabel will decompose it, about


def _seconds(problem: PGOProblem, tree: CliqueTree, form: RelaxationForm, solver: ConvexSolver) -> float:
    sides = _sides(problem, tree, form)
    if not solver.is_first_order:
        return float(_CLARABEL_ITERATIONS * np.sum(_triangle(sides) ** 3) / _CLARABEL_RATE)
    return float(_SCS_ITERATIONS * np.sum(sides**3) / _SCS_RATE)


def _memory(problem: PGOProblem, tree: CliqueTree, form: RelaxationForm, solver: ConvexSolver) -> float:
    triangles = _triangle(_sides(problem, tree, form))
    cones = _CLARABEL_BYTES * np.sum(triangles**2) if not solver.is_first_order else 0.0
    # Of the dual, cvxpy vectorises the inequality as a whole.
    dense = {RelaxationForm.PRIMAL: problem.d * problem.num_poses, RelaxationForm.DUAL: problem.side}.get(form, 0)
    return float(cones + _SCS_BYTES * np.sum(triangles) + _CONE_BYTES * len(triangles) + _DENSE_BYTES * dense**2)


def _triangle(side: Array) -> Array:
    return side * (side + 1) / 2


def _bytes(count: float) -> str:
    return f"{count / 1e9:.2g} GB" if count >= 1e9 else f"{count / 1e6:.2g} MB"
