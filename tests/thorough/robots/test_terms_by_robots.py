"""Handedness terms of a solve by robots, which are sought where the whole graph is."""

import numpy as np
import pytest

from solvers import Status, SweptScene, solve
from solvers.studies.tightness import noisy_scene


@pytest.mark.slow  # solves from end to end
@pytest.mark.parametrize(
    ("scene", "degrees", "seed"),
    [(SweptScene.CIRCLE, 60, 0), (SweptScene.GRID, 60, 1)],
)
def test_robots_certify_what_the_relaxation_leaves_open(
    scene: SweptScene, degrees: float, seed: int
) -> None:
    graph = noisy_scene(scene, np.deg2rad(degrees), np.random.default_rng(seed))
    central = solve(graph)
    solution = solve(graph, robots=4)
    assert solution.is_certified
    assert solution.status is Status.CONVERGED
    assert solution.certificate.bound.terms is not None
    assert solution.stages[-1].name == "HandednessAscent, in one place"
    assert solution.lower_bound == pytest.approx(central.lower_bound, rel=1e-9)
