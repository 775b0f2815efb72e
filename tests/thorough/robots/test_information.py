"""chi2 by driver and robots: the same optimum, bound and account as in one place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS, informed, varied_graph
from hypothesis import given, settings, strategies as st

import solvers
from pgo_models import NoiseModel, PGOProblem, Verdict, Weighting, circle, partition
from pgo_models.errors import SettingError
from pgo_models.graphs.precisions import proper_information
from solvers import Checkpoint, Coupling, polish

QUIET = NoiseModel(0.02, 0.02)


def of_file(seed: int, n: int, d: int, coupled: bool, spread: float = 0.4) -> PGOProblem:
    graph = informed(seed, n, d, coupled, spread, QUIET)
    if d == 3:  # rotation blocks far from isotropic let no relaxation be tight
        information = proper_information(graph).copy()
        information[:, 3:, 3:] = np.eye(3) * information[:, 3, 3][:, None, None]
        information[:, :3, 3:] *= 0.1
        information[:, 3:, :3] *= 0.1
        graph = replace(graph, information=information)
    return PGOProblem(graph, weighting=Weighting.INFORMATION)


@settings(max_examples=examples(12))
@given(
    seed=SEEDS, n=st.integers(6, 20), d=DIMENSIONS, coupled=st.booleans(), robots=st.integers(1, 4)
)
def test_robots_find_what_one_place_finds(
    seed: int, n: int, d: int, coupled: bool, robots: int
) -> None:
    problem = of_file(seed, n, d, coupled)
    central = solvers.solve(problem, progress=False)
    shared = solvers.solve(problem, robots=robots, progress=False)
    level = 10.0 * central.certificate.rounding_level  # of trees, whose measurements agree
    assert shared.objective == pytest.approx(central.objective, rel=1e-9, abs=level)
    assert shared.lower_bound <= (1 + 1e-12) * central.objective + level
    if central.certificate.verdict is Verdict.CERTIFIED:
        assert shared.certificate.verdict is Verdict.CERTIFIED
    for stage in shared.stages:
        assert stage.objective >= (1 - 1e-9) * central.objective - level
    assert shared.ledger.rounds > 0


@pytest.mark.parametrize("coupling", [Coupling.SUBSTRUCTURED, Coupling.CONSENSUS, Coupling.JOINT])
@pytest.mark.parametrize("d", [2, 3])
def test_every_coupling_ends_at_the_minimum_of_chi2(d: int, coupling: Coupling) -> None:
    problem = of_file(5, 20, d, coupled=False)
    central = solvers.solve(problem, progress=False)
    robots = partition(problem.graph, 3) if coupling is not Coupling.JOINT else None
    pipeline = solvers.Pipeline(soc=solvers.SOC(coupling=coupling, robots=robots))
    for on_robots in {None, robots}:
        solution = solvers.solve(problem, pipeline, robots=on_robots, progress=False)
        assert solution.objective == pytest.approx(central.objective, rel=1e-9)
        assert solution.certificate.verdict is central.certificate.verdict
        assert solution.stages[-1].objective == pytest.approx(
            problem.objective(solution.poses), rel=1e-12
        )


@pytest.mark.parametrize("coupling", [Coupling.SUBSTRUCTURED, Coupling.CONSENSUS])
def test_rotation_information_alone_is_solved_by_soc_itself(coupling: Coupling) -> None:
    graph = circle(np.random.default_rng(0))
    information = proper_information(graph).copy()
    information[:, 3:, 3:] = np.diag([1.0, 1.5, 2.0]) * information[0, 3, 3]
    problem = PGOProblem(replace(graph, information=information), weighting=Weighting.INFORMATION)
    assert problem.convex_part is problem
    soc = solvers.SOC(
        coupling=coupling, robots=partition(graph, 3), tolerance=1e-9, max_iterations=2000
    )
    alone = solvers.run(soc, problem)
    solution = solvers.solve(problem, progress=False)
    assert solution.is_certified
    assert alone.objective == pytest.approx(solution.objective, rel=1e-7)


def test_a_run_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    problem = of_file(2, 20, 2, coupled=True)
    whole = solvers.solve(problem, robots=3, progress=False)
    seen = []

    def stop(state: object, record: object) -> bool:
        seen.append(state)
        return len(seen) >= 4

    checkpoint = Checkpoint(tmp_path / "run.ckpt", rounds=1)
    solvers.solve(
        problem, robots=solvers.Robots(3, checkpoint=checkpoint), progress=False, callback=stop
    )
    again = solvers.solve(problem, robots=solvers.Robots(3, checkpoint=checkpoint), progress=False)
    assert again.objective == pytest.approx(whole.objective, rel=1e-12)
    assert again.certificate.verdict is whole.certificate.verdict


@pytest.mark.parametrize("seed", [5, 12, 15, 20])
def test_robots_go_on_until_the_tangent_is_as_sharp_as_in_one_place(seed: int) -> None:
    """What is left of chi2 weighs up to the condition of I_tt more in the bound."""
    d = 2 + seed % 2
    rng = np.random.default_rng(seed)
    graph = informed(seed, 25, d, False, 0.3, QUIET)
    information = proper_information(graph).copy()
    axes = np.linalg.qr(rng.standard_normal((graph.num_edges, d, d)))[0]
    information[:, :d, :d] = (
        axes * 10.0 ** rng.uniform(-6, 0, (graph.num_edges, 1, d))
    ) @ np.swapaxes(axes, 1, 2)
    if d == 3:
        information[:, 3:, 3:] = np.eye(3) * information[:, 3, 3][:, None, None]
    problem = PGOProblem(replace(graph, information=information), weighting=Weighting.INFORMATION)
    central, shared = (
        solvers.solve(problem, robots=robots, progress=False) for robots in (None, 3)
    )
    assert shared.gap <= 4.0 * central.gap
    assert shared.stages[-1].status is solvers.Status.CONVERGED


def test_without_a_driver_chi2_is_refused() -> None:
    problem = of_file(0, 10, 2, coupled=False)
    soc = solvers.SOC(coupling=Coupling.CONSENSUS, robots=partition(problem.graph, 2))
    with pytest.raises(SettingError, match="without a driver"):
        solvers.solve(
            problem,
            solvers.Pipeline(soc=soc),
            robots=solvers.Robots(soc.robots, driver_memory=0),
            progress=False,
        )


@pytest.mark.parametrize("robots", [None, 3])
@pytest.mark.parametrize("has_positions", [False, True])
def test_quadratic_chi2_that_is_not_convex_has_an_answer_and_a_bound(
    has_positions: bool, robots: int | None
) -> None:
    graph = varied_graph(0, 20, 3)
    information = np.tile(
        np.diag([4.0, 4.0, 5.0 if has_positions else 4.0, 40.0, 40.0, 100.0]),
        (graph.num_edges, 1, 1),
    )
    graph = replace(graph, information=information)
    if has_positions:
        assert graph.truth is not None
        graph = graph.with_position_prior(np.arange(0, 20, 4), graph.truth.t[::4], 4.0)
    problem = PGOProblem(graph, weighting=Weighting.INFORMATION)
    assert not problem.weights.is_convex
    solution = solvers.solve(problem, robots=robots)
    # The relaxation is not tight; handedness terms close the gap, with and without robots.
    assert solution.is_certified
    assert solution.certificate.bound.terms is not None
    assert solution.lower_bound <= solution.objective
    assert solution.objective <= problem.objective(polish(problem, graph.truth)) * (1 + 1e-9)
