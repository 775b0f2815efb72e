"""A user's own step (a), rule of the penalty, set and constraint, in place of the library's."""

from dataclasses import dataclass
from itertools import islice

import cvxpy as cp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.sparse.linalg import splu

import pgo_models as pgo
import solvers
from pgo_models.convex.graph_subproblem import PoseVariables
from pgo_models.errors import SettingError
from solvers.soc.r_step import RSubproblem


class OwnStep:
    """Step (a) by SciPy's sparse LU."""

    def prepare(self, subproblem: RSubproblem) -> "OwnFactor":
        return OwnFactor(splu(subproblem.matrix), 0.5 * subproblem.rho[:, None])


@dataclass
class OwnFactor:
    lu: object
    half_penalty: np.ndarray

    def solve(self, V: np.ndarray) -> np.ndarray:
        return self.lu.solve(self.half_penalty * V)  # type: ignore[attr-defined]


class Doubling:
    """Begin where BalancedPenalty does, and double all penalties as long as the copies move far."""

    def bounds(self, ratio: np.ndarray) -> tuple[float, float, float]:
        return 0.0, 0.3, 0.0

    def rescaling(self, primal_residual: float, dual_residual: float) -> float:
        return 2.0 if dual_residual > 0.05 else 1.0


class SignedPermutations(pgo.ConstraintSet):
    """Matrices with one entry of -1 or 1 in every row and column."""

    def project(self, V: np.ndarray) -> np.ndarray:
        rows, columns = linear_sum_assignment(-np.abs(V))
        P = np.zeros(V.shape)
        P[rows, columns] = np.where(V[rows, columns] < 0, -1.0, 1.0)
        return P


def test_an_own_r_step_has_the_iterates_of_the_library() -> None:
    graph = pgo.load("grid")
    own = solvers.run(solvers.SOC(r_step=OwnStep()), graph)
    of_library = solvers.run(solvers.SOC(), graph)
    assert own.iterations == of_library.iterations
    np.testing.assert_allclose(own.poses.R, of_library.poses.R, rtol=0, atol=1e-9)


@pytest.mark.parametrize("method", [solvers.SOC, solvers.PaperSOC])
def test_an_own_rule_of_the_penalty_moves_it(method) -> None:
    problem = pgo.PGOProblem(pgo.load("grid"))
    states = list(islice(solvers.iterate(method(penalty=Doubling()), problem), 31))
    factors = np.log2(states[-1].rho / states[0].rho)
    assert np.min(factors) >= 1.0
    np.testing.assert_allclose(factors, np.round(factors), rtol=0, atol=1e-12)


def test_a_run_with_an_own_rule_ends_at_the_minimum() -> None:
    run = solvers.run(solvers.SOC(penalty=Doubling()), pgo.load("grid"))
    assert run.status is solvers.Status.CONVERGED
    assert run.objective == pytest.approx(solvers.solve(pgo.load("grid")).objective, rel=1e-6)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"bounds": lambda self, ratio: (1.0, 2.0)}, "bounds returned .* give three numbers"),
        ({"bounds": lambda self, ratio: (1.0, -2.0, 0.0)}, "bounds returned .* not negative"),
        ({"rescaling": lambda self, primal, dual: 0.0}, "rescaling returned 0.0; it must be"),
    ],
)
def test_a_rule_that_returns_no_penalty_is_named(wrong, message) -> None:
    rule = type("Wrong", (Doubling,), wrong)()
    with pytest.raises(SettingError, match=f"Wrong.{message}"):
        solvers.run(solvers.SOC(penalty=rule), pgo.load("grid"))


def test_a_rule_without_a_method_is_refused() -> None:
    with pytest.raises(SettingError, match=r"penalty must be a PenaltyRule, .* no `bounds`"):
        solvers.SOC(penalty=object())  # type: ignore[arg-type]


def test_an_own_set_needs_its_projection_alone() -> None:
    rng = np.random.default_rng(1)
    hidden = SignedPermutations().project(rng.standard_normal((4, 4)))
    points = rng.standard_normal((4, 12))
    X = cp.Variable((4, 4))
    mismatch = cp.Problem(cp.Minimize(cp.sum_squares(X @ points - hidden @ points)))
    problem = pgo.OrthogonalProblem(mismatch, sets=[(X, SignedPermutations())])
    solution = solvers.solve_orthogonal(problem, 0)
    assert solution.status is solvers.Status.CONVERGED
    np.testing.assert_array_equal(solution.values[0], hidden)
    assert solution.kkt.feasibility == 0.0


class Flat(pgo.ConstraintSet):
    """It forgets the shape."""

    def project(self, V: np.ndarray) -> np.ndarray:
        return V.ravel()


@pytest.mark.parametrize(
    ("sets", "message"),
    [
        (lambda X: [(X, SignedPermutations)], "sets must be a list, each a tuple"),
        (lambda X: [X], "sets must be a list, each a tuple"),
        (lambda X: [(X, Flat())], r"Flat.project returned an array of shape \(9,\)"),
    ],
)
def test_a_wrong_set_is_named(sets, message) -> None:
    X = cp.Variable((3, 3))
    objective = cp.Problem(cp.Minimize(cp.norm1(X)))
    with pytest.raises(SettingError, match=message):
        solvers.solve_orthogonal(pgo.OrthogonalProblem(objective, sets=sets(X)))


def test_an_own_constraint_has_its_dual_value() -> None:
    """F falls with the bound on the residual of an edge at the rate of the dual value."""
    problem = pgo.PGOProblem(pgo.load("grid"))
    solved = solvers.solve(problem).edge_residuals.translation
    e = int(np.argmax(solved))
    bound = 0.7 * float(solved[e])
    written: list[cp.Constraint] = []

    def least_cost(most: float) -> float:
        def changer(unknown: PoseVariables) -> pgo.ModelChange:
            written.append(cp.norm(unknown.translation_residual(e)) <= most)
            return pgo.ModelChange(constraints=[written[-1]])

        method = solvers.ExtendedSOC(changer, solvers.SOC(tolerance=1e-8))
        return solvers.run(method, problem).history.objective[-1]

    step = 1e-2 * bound
    slope = (least_cost(bound - step) - least_cost(bound + step)) / (2.0 * step)
    written.clear()
    least_cost(bound)
    assert len(written) == 1
    assert slope > 1.0
    assert float(written[0].dual_value) == pytest.approx(slope, rel=1e-2)


class Whole(pgo.ConstraintSet):
    """Vectors of whole numbers, zero among them."""

    def project(self, V: np.ndarray) -> np.ndarray:
        return np.round(V)


def test_zero_may_be_a_point_of_an_own_set() -> None:
    x = cp.Variable(2)
    J = cp.Minimize(cp.sum_squares(x - np.array([1.2, 2.9])))
    problem = pgo.OrthogonalProblem(cp.Problem(J), sets=[(x, Whole())])
    for seed in range(5):
        found = solvers.solve_orthogonal(problem, seed).values[0]
        np.testing.assert_array_equal(found, np.round(found))
    at_zero = solvers.solve_orthogonal(problem, 2)
    assert np.isfinite(at_zero.values[0]).all()
