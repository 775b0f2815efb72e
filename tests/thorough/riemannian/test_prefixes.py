"""The start that grows: its order of the poses, its prefixes, and where it leads."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS, varied_graph
from hypothesis import given, settings

import solvers
from pgo_models import (
    NoiseModel,
    PGOProblem,
    PoseGraph,
    Poses,
    Verdict,
    Weighting,
    read_g2o,
    victoria_park,
)
from pgo_models.errors import GraphError
from pgo_models.geometry.rotations import Array
from solvers import Status, iterate
from solvers.riemannian.prefixes import GrowingStart

FIRST_ALONE = solvers.Pipeline(growing=None, other_starts=False, staircase=None)
GROWING = solvers.Pipeline(other_starts=False, staircase=None)


def trees(
    seed: int, num_poses: int = 200, rotation_std: float = 0.15, reach: float = 3.0
) -> PoseGraph:
    """Few trees seen from a drive whose odometry soon loses its heading."""
    rng = np.random.default_rng(seed)
    noise = NoiseModel(translation_std=0.05, rotation_std=rotation_std)
    return victoria_park(rng, num_poses=num_poses, noise=noise, reach=reach)


def relative_translations(poses: Poses, i: Array, j: Array) -> Array:
    return np.einsum("nba,nb->na", poses.R[i], poses.t[j] - poses.t[i])


@settings(max_examples=examples(10))
@given(seed=SEEDS, d=DIMENSIONS)
def test_without_noise_every_state_is_exact(seed: int, d: int) -> None:
    graph = without_noise(varied_graph(seed, 20, d))
    problem = PGOProblem(graph)
    scale = float((graph.kappa.sum() + graph.tau.sum()) * (1 + np.abs(graph.truth.t).max() ** 2))
    states = iterate(GrowingStart(first_size=3), problem)
    for _ in range(5):
        assert problem.objective(next(states).poses) <= 1e-20 * scale


def without_noise(graph: PoseGraph) -> PoseGraph:
    truth = graph.truth
    assert truth is not None
    R_i = truth.R[graph.i]
    R_ij = np.swapaxes(R_i, 1, 2) @ truth.R[graph.j]
    return replace(graph, R_ij=R_ij, t_ij=relative_translations(truth, graph.i, graph.j))


@pytest.mark.parametrize("weighting", [Weighting.ISOTROPIC, Weighting.INFORMATION])
@pytest.mark.parametrize(
    "park", [(3, 200, 0.12, 3.0), (2, 400, 0.1, 3.0), (2, 400, 0.1, 5.0), (2, 400, 0.12, 5.0)]
)
def test_it_reaches_the_certified_optimum_where_a_batch_start_does_not(
    park: tuple[int, int, float, float], weighting: Weighting
) -> None:
    problem = PGOProblem(trees(*park), weighting=weighting)
    batch = solvers.solve(problem, FIRST_ALONE)
    grown = solvers.solve(problem, GROWING)
    assert not batch.is_certified
    assert grown.certificate.verdict is Verdict.CERTIFIED
    assert grown.objective < 0.9 * batch.objective
    assert batch.lower_bound <= grown.objective
    names = [stage.name for stage in grown.stages]
    assert names == ["averaged start", "Newton", "growing start", "Newton"]
    assert len(grown.stages[2].history) == grown.stages[2].iterations + 1


@pytest.mark.parametrize("has_checkpoint", [False, True])
def test_robots_go_on_from_a_start_that_grows_in_one_place(
    has_checkpoint: bool, tmp_path: Path
) -> None:
    problem = PGOProblem(trees(3, 200, 0.12, 3.0))
    checkpoint = solvers.Checkpoint(tmp_path / "state.ckpt") if has_checkpoint else None
    shared = solvers.solve(problem, GROWING, robots=solvers.Robots(3, checkpoint=checkpoint))
    assert shared.certificate.verdict is Verdict.CERTIFIED
    assert shared.objective == pytest.approx(solvers.solve(problem, GROWING).objective, rel=1e-9)
    assert [stage.name for stage in shared.stages] == [
        "averaged start",
        "Newton",
        "growing start, in one place",
        "Newton",
    ]
    assert solvers.solve(problem, FIRST_ALONE, robots=3).note == ""


def with_wrong_edges(seed: int, count: int) -> PGOProblem:
    graph = trees(seed)
    rng = np.random.default_rng(seed)
    wrong = rng.integers(0, 200, (count, 2))
    far = np.abs(wrong[:, 0] - wrong[:, 1]) > 20
    i, j = wrong[far].T
    measured = Poses.of_points(rng.standard_normal((len(i), 2)))
    return PGOProblem(graph.with_edges(i, j, measured, 100.0, 100.0))


def test_a_start_that_grew_in_vain_leaves_robots_the_better_answer() -> None:
    problem = with_wrong_edges(1, 3)
    pipeline = replace(GROWING, other_starts=True)
    solution = solvers.solve(problem, pipeline, robots=3)
    names = [stage.name for stage in solution.stages]
    others = "other starts, in one place: none is better"
    assert names[2:] == ["growing start, in one place", "Newton", others]
    cheapest = min(stage.objective for stage in solution.stages)
    assert solution.objective <= cheapest * (1 + 1e-9)
    assert not solution.is_certified


def test_where_odometry_does_not_join_the_poses_it_is_left_out() -> None:
    graph = trees(0)
    without = graph.without_edges((graph.i == 99) & (graph.j == 100))
    turned = Poses(np.eye(2)[None], np.zeros((1, 2)))
    without = without.with_edges(np.array([99]), np.array([101]), turned, 1.0, 1.0)
    with pytest.raises(GraphError, match="odometry does not join the poses"):
        solvers.run(GrowingStart(), without)
    solution = solvers.solve(without, GROWING)
    stages = [stage for stage in solution.stages if stage.name == "growing start"]
    assert [stage.ending for stage in stages] == ["skipped: odometry does not join the poses"]
    assert "growing start (odometry does not join the poses)" in solution.note


def test_a_certified_answer_ends_the_solve_before_it() -> None:
    graph = victoria_park(np.random.default_rng(0))
    names = [stage.name for stage in solvers.solve(graph).stages]
    assert names == ["averaged start", "Newton"]


@pytest.mark.parametrize("seed", range(4))
def test_no_answer_is_worse_for_it(seed: int) -> None:
    problem = with_wrong_edges(seed, 40)
    batch = solvers.solve(problem, FIRST_ALONE)
    grown = solvers.solve(problem, GROWING)
    assert grown.objective <= batch.objective * (1 + 1e-12)
    cheapest = min(stage.objective for stage in grown.stages)
    assert grown.objective <= cheapest * (1 + 1e-9)
    assert grown.lower_bound >= batch.lower_bound * (1 - 1e-12)


def test_few_steps_of_the_user_are_not_exceeded() -> None:
    problem = PGOProblem(trees(0))
    pipeline = replace(GROWING, newton=solvers.Newton(max_iterations=3))
    solution = solvers.solve(problem, pipeline)
    assert all(stage.iterations <= 3 for stage in solution.stages if stage.name == "Newton")


def test_the_time_limit_ends_it() -> None:
    solution = solvers.solve(PGOProblem(trees(0)), time_limit=1e-9)
    assert solution.status is Status.TIME_LIMIT
    assert "growing start" not in [stage.name for stage in solution.stages]


@pytest.mark.slow
@pytest.mark.filterwarnings(
    "ignore:.*landmarks seen once", "ignore:.*LANDMARK2 matrices", "ignore:.*landmarks are"
)
@pytest.mark.parametrize(
    ("weighting", "optimum"),
    [(Weighting.ISOTROPIC, 466.0304924), (Weighting.INFORMATION, 389.7265658)],
)
def test_the_public_graph_of_victoria_park_is_certified(
    weighting: Weighting, optimum: float, benchmark_data: Path
) -> None:
    """From a batch start F ends at 20787 and chi2 at 8590."""
    graph = read_g2o(benchmark_data / "victoriaPark.g2o")
    solution = solvers.solve(PGOProblem(graph, weighting=weighting))
    assert solution.certificate.verdict is Verdict.CERTIFIED
    assert solution.objective == pytest.approx(optimum, rel=1e-9)
    assert 0 <= solution.certificate.proven_gap < 1e-11
    assert [stage.name for stage in solution.stages][2:] == ["growing start", "Newton"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")  # of landmarks seen once
def test_a_robust_solve_of_victoria_park_ends_near_the_plain_one(benchmark_data: Path) -> None:
    """From odometry it found clusters one after the other, near a map far from the right one."""
    graph = read_g2o(benchmark_data / "victoriaPark.g2o")
    solution = solvers.solve(graph, robust=solvers.GNC(), progress=False)
    assert solution.certificate.verdict is Verdict.CERTIFIED
    assert solution.robust is not None
    assert solution.robust.cost < 89.0  # truncated; 91.9 with 13 edges rejected, 88.7 with 15
    assert solution.robust.start.startswith("from least squares with every edge")
    assert "limit" not in solution.note


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 4, 5])
def test_soc_ends_where_its_residuals_stop_falling(seed: int) -> None:
    """Of these graphs the chordal start is far from the optimum."""
    rng = np.random.default_rng(seed)
    noise = NoiseModel(translation_std=0.05, rotation_std=0.3)
    graph = victoria_park(rng, num_poses=600, noise=noise, reach=3.0)
    run = solvers.run(solvers.SOC(tolerance=1e-6), graph)
    residual = np.maximum(run.history.primal_residual, run.history.dual_residual)
    assert run.status is Status.NO_PROGRESS
    assert not run.status.is_success
    assert run.iterations < 500
    assert residual[-100:].min() > 0.9 * residual[1:-100].min()
