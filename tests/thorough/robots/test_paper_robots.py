"""Algorithm 1 of the paper by robots: the iterates of one place, in one exchange each."""

from itertools import islice, pairwise

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, varied_graph
from hypothesis import given, strategies as st
from robots import Recording

import pgo_models as pgo
import solvers
from pgo_models import partition, spanning_tree_start
from pgo_models.errors import SettingError
from solvers import BalancedPenalty, FixedPenalty, InProcess, PaperSOC, RStep, iterate
from solvers.robots.driver import collect
from solvers.robots.paper import PaperByRobots
from solvers.robots.setup import open_driver
from solvers.soc.penalty import BoydPenalty, PenaltyRule

RULES = [BalancedPenalty(), BoydPenalty(), FixedPenalty(3.0)]
ROBOTS = "robots"


@given(
    seed=SEEDS,
    n=st.integers(2, 12),
    d=DIMENSIONS,
    num_robots=st.integers(1, 4),
    rule=st.sampled_from(RULES),
)
def test_iterates_are_those_of_one_place(
    seed: int, n: int, d: int, num_robots: int, rule: PenaltyRule
) -> None:
    graph = varied_graph(seed, n, d)
    robots = pgo.partition(graph, min(num_robots, n))
    check_iterates(graph, PaperSOC(robots=robots, penalty=rule))


def test_iterates_by_fista_are_those_of_one_place() -> None:
    graph = pgo.load(ROBOTS)
    rule = BalancedPenalty(scale=5.0)  # FISTA takes long where rho is small beside the weights
    check_iterates(graph, PaperSOC(pgo.partition(graph, 4), rule, RStep.FISTA))


def check_iterates(graph: pgo.PoseGraph, soc: PaperSOC) -> None:
    assert soc.robots is not None
    problem = pgo.PGOProblem(graph)
    start = spanning_tree_start(problem.graph)
    method = PaperByRobots(soc)
    driver = open_driver(problem, soc.robots, InProcess())
    driver.set_poses(start)
    at_robots = list(islice(iterate(method, driver), 7))
    in_one_place = list(islice(iterate(soc, problem, start), 7))
    for expected, found in zip(in_one_place[1:], at_robots[1:], strict=True):
        measured = method.measure(driver, found)
        known = soc.measure(problem, expected)
        if min(known.primal_residual, known.dual_residual) < 1e-5:
            break  # residuals of another size than FISTA's accuracy decide about rho alike
        assert found.penalty.rho == pytest.approx(expected.rho, rel=1e-9)
        assert measured.primal_residual == pytest.approx(known.primal_residual, rel=1e-5, abs=1e-7)
        assert measured.dual_residual == pytest.approx(known.dual_residual, rel=1e-5, abs=1e-7)
        method.finish(driver, found)
        np.testing.assert_allclose(collect(driver)[0].R, expected.omega, rtol=0, atol=1e-5)


def test_an_iteration_is_one_exchange_of_R_between_neighbours() -> None:
    """Nine numbers a pose that a neighbour holds, with an all-reduce of five sums for rho."""
    problem = pgo.PGOProblem(pgo.load(ROBOTS))
    robots = partition(problem.graph, 4)
    engine = Recording()
    method = PaperByRobots(PaperSOC())
    driver = open_driver(problem, robots, engine)
    driver.set_poses(spanning_tree_start(problem.graph))
    states = iterate(method, driver)
    ledgers = []
    for _ in islice(states, 4):
        ledgers.append(driver.network.ledger)
    layouts = [agent.copies.layout for agent in engine.agents]
    num_sent = [sum(len(mine) for mine in layout.sent.values()) for layout in layouts]
    for before, after in pairwise(ledgers):
        assert (after.rounds - before.rounds, after.all_reduces - before.all_reduces) == (1, 1)
        links = sum(len(layout.sent) for layout in layouts)
        # Beside them one message from and to every robot of the all-reduce.
        assert after.messages - before.messages == links + 2 * len(layouts)
        sent = (after.bytes_sent - before.bytes_sent).tolist()
        assert sent == [8 * (9 * count + 5) for count in num_sent]


def test_a_solve_by_robots_ends_where_one_place_does() -> None:
    graph = pgo.load(ROBOTS)
    robots = partition(graph, 4)
    pipeline = solvers.Pipeline(soc=PaperSOC(robots=robots))
    found = solvers.solve(graph, pipeline, robots=robots)
    expected = solvers.solve(graph, pipeline)
    assert found.certificate.is_certified
    assert [stage.name for stage in found.stages] == [
        "spanning tree, in one place",
        *[stage.name for stage in expected.stages[1:]],
    ]
    assert found.stages[1].iterations == expected.stages[1].iterations
    assert found.stages[1].objective == pytest.approx(expected.stages[1].objective, rel=1e-6)
    assert found.objective == pytest.approx(expected.objective, rel=1e-9)


def test_robots_with_files_of_their_own_run_it_from_the_chordal_start() -> None:
    found = solvers.solve_folder(ROBOTS, solvers.Pipeline(soc=PaperSOC()))
    assert found.certificate.is_certified
    assert [stage.name for stage in found.stages] == ["chordal start", "PaperSOC", "Newton"]


class OwnBackEnd:
    def prepare(self, subproblem: object) -> object:
        raise AssertionError


def test_a_back_end_of_the_user_s_is_refused() -> None:
    graph = pgo.load(ROBOTS)
    pipeline = solvers.Pipeline(soc=PaperSOC(r_step=OwnBackEnd()))
    with pytest.raises(SettingError, match="robots are sent the name of a back end"):
        solvers.solve(graph, pipeline, robots=4)
    with pytest.raises(SettingError, match="robots are sent the name of a back end"):
        solvers.solve_folder(ROBOTS, pipeline)
    robots = partition(graph, 4)
    with pytest.raises(SettingError, match="are those of the files"):
        solvers.solve_folder(ROBOTS, solvers.Pipeline(soc=PaperSOC(robots=robots)))
