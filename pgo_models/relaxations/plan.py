"""Choose the form of the semidefinite relaxation and its solver, by the sizes of the cliques."""

import enum
from dataclasses import dataclass

import numpy as np

from pgo_models.convex.convex_solver import ConvexSolver, as_solver
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.problem.problem import PGOProblem
from pgo_models.relaxations.clique_tree import CliqueTree, build_clique_tree, clique_side
from pgo_models.summaries import Summarised

DEFAULT_MEMORY_LIMIT = 4e9  # bytes
# An interior-point method is accurate; its work grows with the sixth power of a cone's side. The
# work of a first-order method, which is rougher, grows with the third power.
CLARABEL = ConvexSolver()
SCS = ConvexSolver("SCS")

# Measured on one core (tests/benchmarks/test_relaxations_benchmark.py). Clarabel factors a dense
# matrix of the order of every cone's triangle at every iteration, about 15 of them; SCS takes an
# eigendecomposition of each, about 1000 times.
_CLARABEL_ITERATIONS = 15
_CLARABEL_RATE = 2e10
_SCS_ITERATIONS = 1000
_SCS_RATE = 2e9
_PATIENCE = 2.0  # seconds: up to here the interior point is preferred for its accuracy
_CLARABEL_BYTES = 56.0  # for every entry of those dense matrices: matrix and factor
_SCS_BYTES = 400.0  # for every entry of a cone's triangle: matrices, vectors, cvxpy's copies
_DENSE_BYTES = 64.0  # for every entry of a dense matrix of the model
_CONE_BYTES = 1.2e5  # for every cone, in cvxpy


class RelaxationForm(enum.Enum):
    """How the relaxation is posed."""

    PRIMAL = "min tr(Q Z), Z_ii = I, Z PSD: one dense cone, translations marginalised out"
    DUAL = "max tr(Lambda), M - blockdiag(0, Lambda) PSD: one sparse linear matrix inequality"
    CLIQUES = "one small cone for every clique of a chordal extension"
    HULL = "PRIMAL, and Z_ij in the convex hull of SO(3) at every edge"
    HULL_DUAL = "DUAL, with a multiplier of the convex hull of SO(3) at every edge"

    @property
    def has_hull(self) -> bool:
        """Whether blocks are mixtures of rotations: a tighter relaxation, in space."""
        return self in (RelaxationForm.HULL, RelaxationForm.HULL_DUAL)


@dataclass(frozen=True, eq=False)
class RelaxationPlan(Summarised):
    """A form and a solver, an estimate of their cost, and why they were chosen."""

    form: RelaxationForm
    solver: ConvexSolver
    tree: CliqueTree
    seconds: float  # estimate, rough
    memory: float  # estimate, in bytes
    reason: str

    def __str__(self) -> str:
        return (
            f"{self.form.name} with {self.solver.name}, about {_bytes(self.memory)}: {self.reason}"
        )


def plan_relaxation(
    problem: PGOProblem,
    form: RelaxationForm | None = None,
    solver: ConvexSolver | str | None = None,
    memory_limit: float = DEFAULT_MEMORY_LIMIT,
) -> RelaxationPlan:
    """Choose form and solver, unless they are given.

    They are the cliques with Clarabel where the cliques are small, and else the dense primal with
    SCS; the hull of rotations is posed only where it is asked for. Nothing larger than the clique
    tree is formed. A SettingError when `memory_limit`, in bytes, is exceeded or not positive.
    """
    if not memory_limit > 0:
        raise SettingError(f"memory_limit is {memory_limit}; give positive bytes")
    tree = build_clique_tree(problem.graph)
    if form is None and solver is None:
        form, chosen, reason = _faster_choice(problem, tree)
    else:
        form, chosen, reason = _completed_choice(problem, tree, form, solver)
    memory = _memory(problem, tree, form, chosen)
    if memory > memory_limit:
        raise SettingError(
            f"the relaxation of {problem!r} as {form.name} with {chosen.name} needs about "
            f"{_bytes(memory)}, above the limit of {_bytes(memory_limit)} ({reason}); use "
            "solvers.certify(problem, poses), which proves the same bound by one factorisation, "
            "or raise memory_limit"
        )
    seconds = _seconds(problem, tree, form, chosen)
    return RelaxationPlan(form, chosen, tree, seconds, memory, reason)


def _faster_choice(
    problem: PGOProblem, tree: CliqueTree
) -> tuple[RelaxationForm, ConvexSolver, str]:
    """Form and solver by their estimated times, and the reason."""
    seconds_cliques = _seconds(problem, tree, RelaxationForm.CLIQUES, CLARABEL)
    seconds_dense = _seconds(problem, tree, RelaxationForm.PRIMAL, SCS)
    reason = (
        f"{_size_text(problem, tree)}; estimated {seconds_cliques:.2g} s for the cliques with "
        f"Clarabel, {seconds_dense:.2g} s dense with SCS"
    )
    if seconds_cliques <= max(_PATIENCE, seconds_dense):
        return RelaxationForm.CLIQUES, CLARABEL, reason
    return RelaxationForm.PRIMAL, SCS, reason


def _completed_choice(
    problem: PGOProblem,
    tree: CliqueTree,
    form: RelaxationForm | None,
    solver: ConvexSolver | str | None,
) -> tuple[RelaxationForm, ConvexSolver, str]:
    """Form and solver where at least one of them is given, and the reason."""
    if solver is not None:
        chosen = as_solver(solver)
    else:
        chosen = SCS if form is RelaxationForm.PRIMAL else CLARABEL
    given = []
    if form is not None:
        given.append(form.name)
    if solver is not None:
        given.append(chosen.name)
    if form is None:
        form = RelaxationForm.PRIMAL if chosen.is_first_order else RelaxationForm.CLIQUES
    return form, chosen, f"{' and '.join(given)} as asked for; {_size_text(problem, tree)}"


def _size_text(problem: PGOProblem, tree: CliqueTree) -> str:
    largest = clique_side(int(tree.sizes.max()), problem.d)
    dense = problem.d * problem.num_poses
    return f"the largest of {len(tree.cliques)} cliques has side {largest}, the dense cone {dense}"


def _sides(problem: PGOProblem, tree: CliqueTree, form: RelaxationForm) -> Array:
    """Sides of all cones."""
    if form in (RelaxationForm.PRIMAL, RelaxationForm.HULL):
        return np.array([float(problem.d * problem.num_poses)])
    if form is RelaxationForm.CLIQUES:
        return np.asarray(clique_side(1, problem.d) + (problem.d + 1.0) * (tree.sizes - 1))
    return np.asarray((problem.d + 1.0) * tree.sizes)  # about as Clarabel decomposes the dual


def _seconds(
    problem: PGOProblem, tree: CliqueTree, form: RelaxationForm, solver: ConvexSolver
) -> float:
    sides = _sides(problem, tree, form)
    if not solver.is_first_order:
        return float(_CLARABEL_ITERATIONS * np.sum(_triangle(sides) ** 3) / _CLARABEL_RATE)
    return float(_SCS_ITERATIONS * np.sum(sides**3) / _SCS_RATE)


def _memory(
    problem: PGOProblem, tree: CliqueTree, form: RelaxationForm, solver: ConvexSolver
) -> float:
    triangles = _triangle(_sides(problem, tree, form))
    cones = _SCS_BYTES * np.sum(triangles) + _CONE_BYTES * len(triangles)
    if not solver.is_first_order:
        cones += _CLARABEL_BYTES * np.sum(triangles**2)
    dense_side = 0
    if form in (RelaxationForm.PRIMAL, RelaxationForm.HULL):
        dense_side = problem.d * problem.num_poses
    elif form in (RelaxationForm.DUAL, RelaxationForm.HULL_DUAL):
        dense_side = problem.side  # cvxpy vectorises the inequality as a whole
    return float(cones + _DENSE_BYTES * dense_side**2)


def _triangle(side: Array) -> Array:
    return side * (side + 1) / 2


def _bytes(count: float) -> str:
    return f"{count / 1e9:.2g} GB" if count >= 1e9 else f"{count / 1e6:.2g} MB"
