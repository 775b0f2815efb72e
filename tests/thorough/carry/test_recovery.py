from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np
import pytest
from graphs import random_poses, varied_graph
from robots import driver_at

import solvers
from pgo_models import PartitionMethod, PGOProblem, partition
from pgo_models.errors import EngineError, NotPositiveDefiniteError, SettingError
from solvers import iterate
from solvers.carry.messages import obey
from solvers.carry.recovery import RecoveringPool, Recovery, RobotLostError
from solvers.robots.agent import Agent
from solvers.robots.consensus import ConsensusSOC
from solvers.robots.newton import SubstructuredNewton
from solvers.robots.soc import SubstructuredSOC
from solvers.soc.soc import WARM_START
from solvers.soc.subgraph import split_graph


@dataclass(eq=False)
class Leaky:
    """A place that loses the group of every order with a number in `losses`, before or after it."""

    shares: tuple
    losses: set
    is_before: bool = True
    groups: list = field(default_factory=list)  # every robot alone unless given
    agents: dict = field(default_factory=dict)  # by group
    count: int = 0
    lost: int = 0

    def __post_init__(self):
        self.groups = self.groups or [[robot] for robot in range(len(self.shares))]

    def start(self, groups):
        for group in groups:
            self.agents[group] = [
                Agent(replace(self.shares[robot]), None) for robot in self.groups[group]
            ]

    def send(self, group, order, requests):
        return order, requests

    def receive(self, group, ticket):
        self.count += 1
        if self.count in self.losses and self.is_before:
            self.lose(group)
        answers = obey(self.agents[group], *ticket)
        if self.count in self.losses:
            self.lose(group)
        return answers

    def lose(self, group):
        del self.agents[group]
        self.lost += 1
        raise RobotLostError("gone")

    def close(self):
        self.agents = {}


@dataclass(frozen=True)
class LeakyEngine:
    """Settings of a `Leaky` place; what it has opened is in `opened`."""

    losses: frozenset = frozenset()
    recovery: Recovery = field(default_factory=lambda: Recovery(max_restarts=1000))
    is_before: bool = True
    groups: tuple = ()
    opened: list = field(default_factory=list)

    def open(self, make, shares):
        place = Leaky(shares, set(self.losses), self.is_before, [*self.groups])
        place.start(range(len(place.groups)))
        self.opened.append(RecoveringPool(place, self.recovery))
        return self.opened[-1]


def pipeline(coupling, robots):
    chosen = solvers.Pipeline()
    return replace(
        chosen, soc=replace(WARM_START, coupling=coupling, robots=robots, tolerance=1e-5)
    )


@pytest.mark.parametrize("method", [SubstructuredSOC(), ConsensusSOC(), SubstructuredNewton()])
@pytest.mark.parametrize("orders", [1, 5, 1000])
def test_lost_robots_return_to_the_moments_of_old_states(method, orders):
    # With a snapshot after every order, all that a robot remembers comes from snapshots.
    problem = PGOProblem(varied_graph(3, 30, 3))
    robots = partition(problem.graph, 4, PartitionMethod.CONTIGUOUS)
    start = random_poses(30, 3, 1)
    expected = list(islice(iterate(method, driver_at(problem, robots, start)), 6))
    losses = frozenset(np.random.default_rng(orders).integers(20, 200, 12).tolist())
    engine = LeakyEngine(losses, Recovery(orders, max_restarts=1000))
    driver = driver_at(problem, robots, start, engine)
    film = list(islice(iterate(method, driver), 5))
    for k in (4, 1, 3, 0, 4):
        following = method.measure(driver, method.step(driver, film[k]))
        undisturbed = method.measure(driver, expected[k + 1])
        assert following.objective == undisturbed.objective
        assert following.dual_residual == undisturbed.dual_residual
    (pool,) = engine.opened
    assert pool.place.lost > 1


@pytest.mark.parametrize("orders", [7, 1000])
def test_a_run_that_goes_on_from_a_checkpoint_can_lose_robots(orders, tmp_path):
    class KilledError(BaseException):
        pass

    def kill(state, record):
        if record.k == 9:
            raise KilledError

    graph = varied_graph(6, 60, 3)
    checkpoint = solvers.Checkpoint(tmp_path / "run.ckpt", rounds=2)
    settings = pipeline(solvers.Coupling.SUBSTRUCTURED, None)
    expected = solvers.solve(graph, settings, robots=4)
    losses = frozenset(np.random.default_rng(orders).integers(5, 100, 8).tolist())
    first, second = (LeakyEngine(losses, Recovery(orders, max_restarts=1000)) for _ in range(2))
    with pytest.raises(KilledError):
        solvers.solve(
            graph,
            settings,
            robots=solvers.Robots(4, engine=first, checkpoint=checkpoint),
            callback=kill,
        )
    solution = solvers.solve(
        graph, settings, robots=solvers.Robots(4, engine=second, checkpoint=checkpoint)
    )
    assert second.opened[0].place.lost > 3
    np.testing.assert_array_equal(solution.poses.t, expected.poses.t)
    assert solution.lower_bound == expected.lower_bound


def test_a_robot_that_is_lost_again_and_again_ends_the_run():
    graph = varied_graph(4, 30, 2)
    engine = LeakyEngine(frozenset(range(20, 10_000)), Recovery(max_restarts=2))
    with pytest.raises(
        EngineError, match=r"the process of robots \d was lost 3 times \(gone\); look at the memory"
    ):
        solvers.solve(graph, robots=solvers.Robots(3, engine=engine))


def test_a_robots_own_error_is_told_after_all_have_obeyed_and_is_passed_over_in_the_replay():
    graph = varied_graph(5, 24, 2)
    shares = split_graph(graph, partition(graph, 3))
    obeyed = []

    def refuse(agent, request):
        obeyed.append((agent.subgraph.robot, "refuse"))
        if agent.subgraph.robot == 0:
            raise NotPositiveDefiniteError("no")

    def evaluate(agent, request):
        obeyed.append((agent.subgraph.robot, "evaluate"))
        return agent.subgraph.robot

    place = Leaky(shares, losses={4})
    place.start(range(3))
    pool = RecoveringPool(place, Recovery())
    with pytest.raises(NotPositiveDefiniteError, match="no"):
        pool.ask(refuse, [None] * 3)
    assert obeyed == [(0, "refuse"), (1, "refuse"), (2, "refuse")]
    answers = pool.ask(evaluate, [None] * 3)  # robot 0 is lost here
    assert answers == [0, 1, 2]
    assert obeyed[3:5] == [(0, "refuse"), (0, "evaluate")]
    pool.close()
    assert place.agents == {}


@pytest.mark.parametrize("wrong", [{"orders_between_snapshots": 0}, {"max_restarts": -1}])
def test_settings_are_checked(wrong):
    with pytest.raises(SettingError, match=next(iter(wrong))):
        Recovery(**wrong)
