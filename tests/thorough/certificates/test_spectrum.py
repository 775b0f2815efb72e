"""The eigenpair that shows that a point is no optimum of the relaxation."""

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, random_poses, varied_problem
from hypothesis import assume, given, strategies as st
from scipy.linalg import block_diag

from pgo_models import multipliers, prove_bound
from pgo_models.certificates.lower_bound import smallest_shift
from pgo_models.certificates.spectrum import negative_curvature


@given(seed=SEEDS, n=st.integers(2, 10), d=DIMENSIONS)
def test_it_is_the_smallest_eigenpair_of_the_marginalised_matrix(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    poses = problem.with_best_translations(random_poses(n, d, seed).R)
    Lambda = multipliers(problem, poses)
    S = problem.Q - block_diag(*Lambda)
    smallest = np.linalg.eigvalsh(S)[0]
    eta = smallest_shift(1e-6, problem.objective(poses), problem.num_poses * problem.d)
    assume(smallest < -10 * eta)
    found = negative_curvature(problem, Lambda, eta, np.random.default_rng(0))
    assert found.value == pytest.approx(smallest, rel=1e-2)
    assert found.value == pytest.approx(
        found.v.ravel() @ S @ found.v.ravel(), abs=1e-10 * np.abs(S).max() * n
    )
    assert np.linalg.norm(found.v) == pytest.approx(1)
    assert -smallest <= found.shift * (1 + 1e-9)
    assert found.shift <= 1.34 * -smallest
    assert prove_bound(problem, Lambda, found.shift) is not None
    b = np.concatenate([np.zeros(n), np.random.default_rng(1).standard_normal(n * d)])
    y = found.factor.solve(b)[n:]
    np.testing.assert_allclose(
        (S + found.shift * np.eye(n * d)) @ y, b[n:], rtol=0, atol=1e-6 * np.abs(b).max()
    )
