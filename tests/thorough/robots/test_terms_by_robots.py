"""Handedness terms by robots: their spectra, what is handed out, and the bound are the central
ones.
"""

from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from graphs import LOUD_NOISE, SEEDS, varied_graph
from hypothesis import given, settings, strategies as st
from robots import PARTITIONERS, Partitioner, driver_at, metis

from pgo_models import PGOProblem, Poses, Weighting, chordal_start, multipliers, partition
from pgo_models.certificates.handedness import HandednessTerms, distinct_pairs
from pgo_models.certificates.lower_bound import best_bound_with_terms
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition
from pgo_models.relaxations.rotation_hull import matrices_at
from solvers import Status, SweptScene, polish, run, solve
from solvers.carry.counted_pool import Count
from solvers.carry.messages import restore, take_snapshot
from solvers.carry.serialization import deserialize
from solvers.handedness.ascent import AscentState, HandednessAscent
from solvers.handedness.certificate_spectrum import HandedMatrix, HandedPoint
from solvers.loop import Outcome
from solvers.robots import handedness
from solvers.robots.driver import Driver
from solvers.robots.part import Interior
from solvers.robots.proof import (
    TermsAnswer,
    best_bound_with_terms as best_bound_by_robots,
    prove_grounded,
    prove_with_eta,
    report_terms,
    take_terms,
)
from solvers.studies.tightness import noisy_scene

SIZES = st.integers(3, 12)


def stationary(problem: PGOProblem) -> Poses:
    return problem.at_best_translations(polish(problem, chordal_start(problem)))


def loose(seed: int, n: int) -> tuple[PGOProblem, Poses]:
    problem = PGOProblem(varied_graph(seed, n, 3, LOUD_NOISE), weighting=Weighting.ISOTROPIC)
    return problem, stationary(problem)


def random_multipliers(seed: int, count: int) -> Array:
    roots = np.random.default_rng(seed).standard_normal((count, 4, 4))
    return roots @ np.swapaxes(roots, 1, 2)


def central_terms(problem: PGOProblem, poses: Poses, Pi: Array) -> HandednessTerms:
    i, j = distinct_pairs(problem.graph).T
    T = np.swapaxes(poses.R[i], 1, 2) @ poses.R[j]
    return HandednessTerms.at(poses, i, j, matrices_at(T, Pi))


def driver_with_terms(problem: PGOProblem, parts: Partition, poses: Poses, Pi: Array) -> Driver:
    driver = driver_at(problem, parts, poses)
    driver.describe(Count.PIGGYBACKED)
    handedness.hand_out_terms(driver, distinct_pairs(problem.graph), poses, Pi)
    return driver


def collected_terms(driver: Driver) -> HandednessTerms:
    found = [terms for terms in driver.ask(report_terms, None, Count.OFF) if terms]
    fields = [np.concatenate([getattr(terms, name) for terms in found]) for name in "ijTP"]
    return HandednessTerms(*fields)


def matrix_of(problem: PGOProblem, terms: HandednessTerms) -> Array:
    return np.asarray(terms.taken_off(problem).M.toarray())


@settings(max_examples=examples(20))
@given(seed=SEEDS, n=SIZES, partitioner=PARTITIONERS)
def test_terms_that_are_handed_out_add_up_to_those_of_the_whole_graph(
    seed: int, n: int, partitioner: Partitioner
) -> None:
    problem, poses = loose(seed, n)
    parts = partitioner(problem.graph, seed)
    Pi = random_multipliers(seed, len(distinct_pairs(problem.graph)))
    driver = driver_with_terms(problem, parts, poses, Pi)
    found = matrix_of(problem, collected_terms(driver))
    expected = matrix_of(problem, central_terms(problem, poses, Pi))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


@settings(max_examples=examples(20))
@given(seed=SEEDS, n=SIZES, partitioner=PARTITIONERS)
def test_the_bound_with_terms_is_the_central_one(
    seed: int, n: int, partitioner: Partitioner
) -> None:
    problem, poses = loose(seed, n)
    Pi = 1e-3 * random_multipliers(seed, len(distinct_pairs(problem.graph)))
    driver = driver_with_terms(problem, partitioner(problem.graph, seed), poses, Pi)
    found = best_bound_by_robots(driver, 1e-6, handedness.return_to_best(driver))
    central = best_bound_with_terms(
        problem,
        multipliers(problem, poses),
        poses,
        1e-6,
        problem.objective(poses),
        collected_terms(driver),
    )
    allowed = found.rounding + central.rounding
    if not np.isnan(found.eta) and found.eta > 0.0:
        # what an eta costs, grounded at another pose, is another figure
        return
    assert found.value == pytest.approx(central.value, rel=1e-9, abs=allowed)


def with_rough_terms(robot: Interior, off: float) -> tuple[Interior, TermsAnswer]:
    terms = robot.state.terms
    assert terms is not None
    return take_terms(robot, replace(terms, T=terms.T + off))


def test_the_loss_of_every_robot_is_taken_off_both_forms() -> None:
    problem, poses = loose(0, 12)
    Pi = 1e-3 * random_multipliers(0, len(distinct_pairs(problem.graph)))
    driver = driver_with_terms(problem, partition(problem.graph, 3), poses, Pi)
    less_terms = handedness.return_to_best(driver)
    eta = 0.1 * problem.objective(poses) / (12 * problem.d)
    known = prove_with_eta(driver, eta, less_terms)
    assert known is not None
    driver.ask(with_rough_terms, 1e-7, Count.OFF)
    loss = collected_terms(driver).loss()
    assert loss > 1e-10 * known.value > 0.0
    found = prove_with_eta(driver, eta, less_terms)
    grounded = prove_grounded(driver, eta, less_terms)
    assert found is not None
    assert grounded is not None
    assert found.value == pytest.approx(known.value - loss, rel=1e-13)
    assert grounded.rounding >= loss


def ascents(
    problem: PGOProblem, parts: Partition, poses: Poses, ascent: HandednessAscent
) -> tuple[Outcome[AscentState[HandedPoint]], Outcome[AscentState[handedness.RobotsPoint]], Driver]:
    """The same ascent in one place and by robots, grounded at the same pose."""
    driver = driver_at(problem, parts, poses)
    driver.describe(Count.PIGGYBACKED)
    i, j = distinct_pairs(problem.graph).T
    matrix = HandedMatrix(problem, multipliers(problem, poses), poses, i, j)
    matrix.__dict__["ground"] = int(driver.cover[driver.grounded_position])
    central = run(ascent, HandedPoint.first(matrix, None, ascent.num_eigenvalues))
    handedness.begin_without_terms(driver)
    by_robots = run(ascent, handedness.RobotsPoint.first(driver, ascent.num_eigenvalues))
    return central, by_robots, driver


@pytest.mark.parametrize(("scene", "degrees"), [(SweptScene.CIRCLE, 70), (SweptScene.GRID, 60)])
def test_an_ascent_by_robots_is_that_of_one_place(scene: SweptScene, degrees: float) -> None:
    graph = noisy_scene(scene, np.deg2rad(degrees), np.random.default_rng(0))
    problem = PGOProblem(graph)
    poses = solve(problem).poses
    poses = problem.at_best_translations(poses)
    ascent = HandednessAscent(max_iterations=8)
    central, by_robots, driver = ascents(problem, metis(graph, 3), poses, ascent)
    # the eigenvalues above the smallest are known less well to either
    np.testing.assert_allclose(by_robots.state.best, central.state.best, rtol=0.15, atol=1e-6)
    assert by_robots.state.smallest > 0.3 * by_robots.state.best[0]
    # the P of the best point come back
    best = handedness.return_to_best(driver)
    assert np.isfinite(best).all()
    again = handedness.RobotsPoint.first(driver, ascent.num_eigenvalues)
    assert again.values[0] == pytest.approx(by_robots.state.best[-1], rel=0.02, abs=1e-6)


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
    assert solution.stages[-1].name == "HandednessAscent"
    assert solution.lower_bound == pytest.approx(central.lower_bound, rel=1e-9)


def test_the_state_of_an_ascent_survives_a_snapshot() -> None:
    graph = noisy_scene(SweptScene.CIRCLE, np.deg2rad(70), np.random.default_rng(0))
    problem = PGOProblem(graph)
    poses = stationary(problem)
    Pi = random_multipliers(0, len(distinct_pairs(graph)))
    driver = driver_with_terms(problem, partition(graph, 3), poses, Pi)
    before = best_bound_by_robots(driver, 1e-6, handedness.return_to_best(driver))
    snapshots = driver.network.ask(take_snapshot, [None] * 3, Count.OFF)
    handedness.begin_without_terms(driver)
    driver.network.ask(restore, [deserialize(each) for each in snapshots], Count.OFF)
    after = best_bound_by_robots(driver, 1e-6, handedness.return_to_best(driver))
    assert after.value == before.value
