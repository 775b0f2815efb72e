"""What a pickle and a deep copy keep: every public object, after it was used, and what is computed
from it then.
"""

import copy
import enum
import functools
import inspect
import math
import multiprocessing
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from every_solver import SOLVERS
from orthogonal_models import smallest_eigenvectors
from signals import sparse_signal

import pgo_models as pgo
import solvers
from pgo_models import multipliers
from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.convex.orthogonality_examples import procrustes
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.marginals import Marginals
from solvers import iterate, run
from solvers.carry.ledger import Traffic
from solvers.reporting.edge_fit import judge_edges
from solvers.soc.r_step import RotationStep, RSubproblem
from solvers.studies.comparison import Comparison
from solvers.studies.paper_tables import Reproduction, ReproductionSettings

Make = Callable[[], Any]
GRAPH = pgo.random_geometric(12, np.random.default_rng(0), d=2)
BACKENDS = pytest.mark.parametrize("backend", CholeskyBackend, ids=lambda backend: backend.name)


def pickled(value: Any) -> Any:
    return pickle.loads(pickle.dumps(value))


COPIES = pytest.mark.parametrize("copied", [pickled, copy.deepcopy], ids=["pickle", "deepcopy"])


def with_weak_prior(variables: Any) -> pgo.ModelChange:
    return pgo.ModelChange(terms=[0.1 * cp.sum_squares(variables.t[0])])


@functools.cache
def solved(backend: CholeskyBackend = CholeskyBackend.CHOLMOD) -> solvers.Solution:
    solution = solvers.solve(pgo.PGOProblem(GRAPH, backend))
    str(solution), solution.marginals(), solution.edge_residuals, solution.as_json()
    return solution


def marginals() -> Marginals:
    problem = solved().problem
    poses = solved().poses
    hessian = riemannian_hessian(problem.at(poses), multipliers(problem, poses))
    found = Marginals(hessian, TangentLayout(problem.num_poses, problem.d))
    found.joint(1, 2)
    assert found.diagonal.size
    return found


def chi2_solution() -> solvers.Solution:
    upper = np.broadcast_to(np.eye(3) + 0.1, (GRAPH.num_edges, 3, 3))
    return solvers.solve(
        pgo.PGOProblem(replace(GRAPH, information=upper), weighting=pgo.Weighting.INFORMATION)
    )


def bregman_outcome() -> Any:
    return run(solvers.Bregman(), sparse_signal(0, 12, 6, 2)[0])


def quadratic_program() -> pgo.GraphQP:
    return pgo.graph_qp(GRAPH, np.full(GRAPH.num_poses, 5.0), changer=with_weak_prior)


@functools.cache
def comparison() -> Comparison:
    return solvers.compare_methods(pgo.PGOProblem(GRAPH))


def handedness_terms() -> object:
    graph = pgo.circle(np.random.default_rng(0))
    P = np.tile(np.eye(3), (graph.num_edges, 1, 1))
    return HandednessTerms.at(graph.truth, graph.i, graph.j, P)


def subproblem() -> RSubproblem:
    """Subproblem that a back end of the user is given."""
    given = []

    class Recorder:
        def prepare(self, subproblem: RSubproblem) -> RotationStep:
            given.append(subproblem)
            return solvers.CvxpyStep().prepare(subproblem)

    run(solvers.SOC(r_step=Recorder(), max_iterations=1), pgo.PGOProblem(GRAPH))
    return given[0]


# Everything that is made, by the name of its public class; what no name stands for is a result of a
# public function.
MADE: dict[str, Make] = {
    "EvaluatedPoses": lambda: pgo.PGOProblem(GRAPH).at(pgo.chordal_start(pgo.PGOProblem(GRAPH))),
    "PGOError": lambda: pgo.PGOError("a reason"),
    "Poses": lambda: solved().poses,
    "PoseGraph": lambda: solved().problem.graph,
    "Partition": lambda: pgo.partition(GRAPH, 3),
    "Marginals": marginals,
    "PGOProblem": lambda: solved().problem,
    "Certificate": lambda: solved().certificate,
    "BregmanProblem": lambda: sparse_signal(0, 12, 6, 2)[0],
    "ConvexSolver": pgo.ConvexSolver,
    "OrthogonalProblem": lambda: smallest_eigenvectors(np.diag([1.0, 2.0, 3.0]), 1),
    "ModelChange": lambda: pgo.ModelChange(terms=[cp.sum_squares(cp.Variable(2))]),
    "LowerBound": lambda: solved().certificate.bound,
    "EdgeResiduals": lambda: solved().edge_residuals,
    "NoiseModel": pgo.NoiseModel,
    "GraphQP": quadratic_program,
    "PoseVariables": lambda: quadratic_program().variables,
    "RotationQP": lambda: quadratic_program().qp,
    "RelaxationSolution": lambda: pgo.solve_relaxation(pgo.PGOProblem(GRAPH)),
    "Term": lambda: smallest_eigenvectors(np.diag([1.0, 2.0, 3.0]), 1).terms[0],
    "History": lambda: run(solvers.SOC(), pgo.PGOProblem(GRAPH)).history,
    "Measurement": lambda: (
        run(solvers.Newton(), pgo.PGOProblem(GRAPH)).history.records[-1].measurement
    ),
    "Record": lambda: run(solvers.Newton(), pgo.PGOProblem(GRAPH)).history.records[-1],
    "Run": lambda: run(solvers.SOC(), pgo.PGOProblem(GRAPH)),
    "Stage": lambda: solved().stages[0],
    "RobotsSolution": lambda: solvers.solve_folder("robots"),
    "Pipeline": solvers.Pipeline,
    "Solution": solved,
    "SOC": lambda: solvers.SOC(robots=pgo.partition(GRAPH, 3)),
    "FixedPenalty": lambda: solvers.FixedPenalty(1.0),
    "Ledger": lambda: solvers.solve(GRAPH, robots=3).ledger,
    "Checkpoint": lambda: solvers.Checkpoint(Path("x")),
    "ExtendedSOC": lambda: solvers.ExtendedSOC(changer=with_weak_prior),
    "a solution by robots": lambda: solvers.solve(GRAPH, robots=3),
    "a robust solution": lambda: solvers.solve(GRAPH, robust=solvers.GNC()),
    "a robust solution by consistency": lambda: solvers.solve(GRAPH, robust=solvers.PCM()),
    "a solution of chi2": chi2_solution,
    "an extended run": lambda: run(
        solvers.ExtendedSOC(changer=with_weak_prior), pgo.PGOProblem(GRAPH)
    ),
    "a comparison's table": lambda: comparison().table(),
    "Comparison": comparison,
    "Outcome": bregman_outcome,
    "OrthogonalSolution": lambda: solvers.solve_orthogonal(
        smallest_eigenvectors(np.diag([1.0, 2.0, 3.0]), 1), rng=np.random.default_rng(0)
    ),
    "ModelCertificate": lambda: (
        solvers.solve_orthogonal(procrustes(np.eye(3), np.ones((3, 2)))).certificate
    ),
    "QuadraticForm": lambda: pgo.quadratic_form(procrustes(np.eye(3), np.ones((3, 2)))),
    "OutlierProof": lambda: (
        solvers.prove_outliers(solvers.solve(GRAPH, robust=solvers.GNC())).robust.proof
    ),
    "Rejection": lambda: solvers.solve(GRAPH, robust=solvers.GNC()).robust,
    "EdgeFit": lambda: judge_edges(solved().problem, solved().poses),
    "RSubproblem": subproblem,
    "HandednessTerms": handedness_terms,
    "Traffic": lambda: Traffic(np.array([0]), np.array([1]), np.array([8])),
    "NoiseSweep": lambda: solvers.noise_sweep(
        solvers.SweptScene.GRID, np.array([0.1]), 1, np.random.default_rng(0)
    ),
    "Reproduction": lambda: Reproduction(ReproductionSettings(), (), True),
}


def verification() -> object:
    with tempfile.TemporaryDirectory() as folder:
        proof = Path(folder) / "proof.json"
        solvers.solve(pgo.load("grid")).save_proof(proof)
        return pgo.verify_proof(Path(__file__).parents[2] / "data" / "grid.g2o", proof)


MADE["Verification"] = verification
MADE["NoiseEstimate"] = lambda: solvers.estimate_noise(GRAPH)
MADE["NoiseLevel"] = lambda: solvers.estimate_noise(GRAPH).levels[0]
MADE["ReadingComparison"] = lambda: solvers.compare_readings("grid")
MADE["Fit"] = lambda: solvers.solve(GRAPH).certificate.fit
MADE["ReadingFit"] = lambda: solvers.compare_readings("grid").written
SETTINGS = (
    "CvxpyStep",
    "PaperSOC",
    "BalancedPenalty",
    "MultiplierPenalty",
)
SETTINGS += (
    "Newton",
    "Staircase",
    "GNC",
    "IRLS",
    "PCM",
    "GaussSeidel",
    "Faults",
    "Robots",
    "InProcess",
)
SETTINGS += (
    "RayEngine",
    "AlternatingBregman",
    "Bregman",
    "MethodOfMultipliers",
    "TwoLineBregman",
    "OrthogonalSOC",
)
SETTINGS += ("BenchmarkSettings", "ComparisonSettings")
MADE |= {name: getattr(solvers, name) for name in SETTINGS}
MADE["Robot"] = lambda: solvers.Robot("a", ["a", "b"], b"sixteen or more bytes")
PROTOCOLS = {
    "Solver",
    "ConstraintSet",
}


def test_every_public_class_is_among_those_made_here():
    public = {name: getattr(door, name) for door in (pgo, solvers) for name in door.__all__}
    classes = {
        name
        for name, value in public.items()
        if inspect.isclass(value) and not issubclass(value, enum.Enum)
    }
    assert classes - PROTOCOLS <= set(MADE)


def assert_alike(one: Any, other: Any) -> None:
    """Equal as far as can be told from what is public: texts, numbers and arrays."""
    assert type(one) is type(other)
    assert str(one) == str(other) or " at 0x" in str(one)
    for name in dir(one):
        value = None if name.startswith("_") else inspect.getattr_static(one, name, None)
        if isinstance(value, float | int | str | np.ndarray | pgo.Poses):
            given = getattr(one, name)
            found = getattr(other, name)
            given, found = (
                (given.stacked(), found.stacked())
                if isinstance(given, pgo.Poses)
                else (given, found)
            )
            np.testing.assert_array_equal(given, found, err_msg=name)


@COPIES
@pytest.mark.parametrize("make", MADE.values(), ids=MADE)
def test_a_copy_is_like_the_original(make: Make, copied: Callable[[Any], Any]) -> None:
    original = make()
    first = copied(original)
    assert_alike(original, first)
    assert_alike(original, copied(first))
    if isinstance(original, pgo.Poses):
        assert not first.R.flags.writeable


@COPIES
@BACKENDS
def test_what_is_computed_from_a_copy_has_the_same_bits(
    copied: Callable[[Any], Any], backend: Any
) -> None:
    solution = solved(backend)
    other = copied(solution)
    np.testing.assert_array_equal(solution.marginals(), other.marginals())
    again = solvers.solve(other.problem)
    once = solvers.solve(solution.problem)
    np.testing.assert_array_equal(again.poses.R, once.poses.R)
    assert (again.objective, again.lower_bound) == (once.objective, once.lower_bound)
    bounds = [solvers.certify(one.problem, one.poses).lower_bound for one in (solution, other)]
    assert bounds[0] == bounds[1]


@COPIES
@BACKENDS
@pytest.mark.parametrize("make", SOLVERS.values(), ids=SOLVERS)
def test_a_copied_state_goes_on_as_the_original_does(
    make: Any, backend: Any, copied: Callable[[Any], Any]
) -> None:
    problem = pgo.PGOProblem(GRAPH, backend)
    solver = make(problem)
    state = list(islice(iterate(solver, problem), 4))[-1]
    other_solver, other_problem, other = copied((solver, problem, state))
    expected = solver.step(problem, state)
    found = other_solver.step(other_problem, other)
    np.testing.assert_array_equal(
        solver.poses(problem, expected).R, other_solver.poses(other_problem, found).R
    )


def test_a_pool_of_processes_maps_solve():
    graphs = [pgo.random_geometric(12, np.random.default_rng(seed), d=2) for seed in range(3)]
    expected = [solvers.solve(graph) for graph in graphs]
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        found = pool.map(solvers.solve, graphs)
    for one, other in zip(expected, found, strict=True):
        assert one.objective == pytest.approx(other.objective, rel=1e-12)
        assert math.isclose(one.lower_bound, other.lower_bound, rel_tol=1e-9)
        assert other.marginals().shape == one.marginals().shape


def test_no_variable_has_the_number_of_one_that_came_out_of_a_pickle(tmp_path):
    # Both processes count from the same number on; cvxpy takes variables of one number for the same
    # one.
    (tmp_path / "write.py").write_text("""
import pickle, sys
sys.path.insert(0, sys.argv[1])
from signals import sparse_signal
open("problem", "wb").write(pickle.dumps(sparse_signal(0, 12, 6, 2)[0]))
""")
    (tmp_path / "read.py").write_text("""
import pickle
import cvxpy as cp
import solvers
problem = pickle.load(open("problem", "rb"))
numbers = [variable.id for variable in (*problem.variables, *(cp.Variable() for _ in range(20)))]
assert len(set(numbers)) == len(numbers), numbers
open("found", "wb").write(pickle.dumps(solvers.run(solvers.Bregman(), problem).state.x))
""")
    for program in ("write.py", "read.py"):
        command = [sys.executable, program, Path(__file__).parents[1]]
        subprocess.run(command, cwd=tmp_path, check=True)
    expected = run(solvers.Bregman(), sparse_signal(0, 12, 6, 2)[0]).state.x
    np.testing.assert_allclose(pickle.loads((tmp_path / "found").read_bytes()), expected, atol=1e-6)
