"""Sparse signals that Bregman iteration recovers, which several test files share."""

import numpy as np

from pgo_models import BregmanProblem
from pgo_models.convex.bregman_examples import basis_pursuit
from pgo_models.geometry.rotations import Array


def sparse_signal(
    seed: int, m: int = 60, s: int = 30, nonzeros: int = 5
) -> tuple[BregmanProblem, Array]:
    rng = np.random.default_rng(seed)
    K = rng.standard_normal((s, m)) / np.sqrt(s)
    x = np.zeros(m)
    x[rng.choice(m, nonzeros, replace=False)] = rng.choice([-1.0, 1.0], nonzeros) * rng.uniform(
        0.5, 2.0, nonzeros
    )
    return basis_pursuit(K, K @ x), x
