import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel


@pytest.fixture(scope="session")
def solution():
    return solvers.solve(pgo.load("robots"))


@pytest.fixture(scope="session")
def uncertain():
    graph = pgo.random_geometric(12, np.random.default_rng(5), noise=NoiseModel(1.0, 2.5))
    solution = solvers.solve(graph, solvers.Pipeline(handedness=None))  # they would certify it
    assert not solution.is_certified
    return solution
