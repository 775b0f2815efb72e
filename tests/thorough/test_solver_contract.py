"""What every solver promises, whatever its method, in one place and by robots."""

import copy
import dataclasses
import enum
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import islice
from typing import Any

import numpy as np
import pytest
from budget import examples
from every_solver import SOLVERS
from graphs import DIMENSIONS, SEEDS, random_poses, varied_problem
from hypothesis import given, settings, strategies as st
from robots import leaving, metis
from scipy.sparse import issparse

import pgo_models
import solvers
from pgo_models import PGOProblem, Poses, grid
from pgo_models.errors import GraphError, SettingError
from solvers import (
    GNC,
    PCM,
    SOC,
    BalancedPenalty,
    Checkpoint,
    ExtendedSOC,
    Faults,
    FixedPenalty,
    InProcess,
    MultiplierPenalty,
    Newton,
    Solver,
    Staircase,
    Status,
    iterate,
    run,
)
from solvers.carry.process import Engine
from solvers.loop import Method
from solvers.robots.climb import SubstructuredStaircase
from solvers.robots.consensus import AsynchronousSOC, ConsensusSOC
from solvers.robots.driver import Driver
from solvers.robots.newton import SubstructuredNewton
from solvers.robots.reweigh import SharedGNC
from solvers.robots.setup import open_driver
from solvers.robots.soc import SubstructuredSOC

Make = Callable[..., Any]


EVERY = pytest.mark.parametrize("make", SOLVERS.values(), ids=SOLVERS)
SIZES = st.integers(3, 10)


def snapshot(value: Any) -> Any:
    """Deep copy of all arrays and numbers that a state holds; what is opaque stays as it is."""
    if isinstance(value, np.ndarray):
        return value.copy()
    if issparse(value):
        return value.copy()
    if isinstance(value, PGOProblem | enum.Enum):
        return value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: snapshot(getattr(value, field.name)) for field in dataclasses.fields(value)
        }
    if isinstance(value, tuple | list):
        return [snapshot(item) for item in value]
    return value


def assert_same(one: Any, other: Any, where: str = "state") -> None:
    """Bit for bit."""
    assert type(one) is type(other), where
    if isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, other, err_msg=where)
    elif issparse(one):
        np.testing.assert_array_equal(one.toarray(), other.toarray(), err_msg=where)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for name in one:
            assert_same(one[name], other[name], f"{where}.{name}")
    elif isinstance(one, list):
        assert len(one) == len(other), where
        for index, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_same(a, b, f"{where}[{index}]")
    else:
        assert one is other or one == other or (one != one and other != other), where


@EVERY
@settings(max_examples=examples(12))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_a_step_leaves_its_state_alone(make: Make, seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    solver: Solver[Any] = make(problem)
    state = solver.init(problem, random_poses(n, d, seed))
    for _ in range(10):
        before = snapshot(state)
        following = solver.step(problem, state)
        solver.measure(problem, state)
        solver.poses(problem, state)
        assert_same(snapshot(state), before)
        assert following.k == state.k + 1
        state = following


@EVERY
@settings(max_examples=examples(10))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_a_start_is_left_alone_and_is_state_zero(make: Make, seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    start = random_poses(n, d, seed)
    kept = copy.deepcopy(start)
    solver: Solver[Any] = make(problem, max_iterations=5)
    np.testing.assert_array_equal(solver.poses(problem, solver.init(problem, start)).R, start.R)
    result = run(solver, problem, start)
    np.testing.assert_array_equal(start.R, kept.R)
    np.testing.assert_array_equal(start.t, kept.t)
    assert result.history.k[0] == 0


@EVERY
def test_a_converged_state_stays(make: Make) -> None:
    problem = PGOProblem(grid(np.random.default_rng(0)))
    solver = tight(make, problem)
    result = run(solver, problem)
    assert result.status is Status.CONVERGED
    state = result.state
    for _ in range(5):
        state = solver.step(problem, state)
        poses = solver.poses(problem, state)
        np.testing.assert_allclose(poses.R, result.poses.R, rtol=0, atol=1e-6)
        assert problem.objective(poses) == pytest.approx(result.objective, rel=1e-6)


def tight(make: Make, problem: PGOProblem) -> Solver[Any]:
    """A solver that leaves about 1e-7 in the rotations: residuals are steps, decrements squared
    ones.
    """
    solver = make(problem)
    tolerance = 1e-13 if isinstance(solver, Newton | Staircase | GNC) else 1e-8
    return dataclasses.replace(solver, tolerance=tolerance, max_iterations=5000)


@EVERY
def test_the_same_seed_gives_the_same_bits(make: Make) -> None:
    results = []
    for _ in range(2):
        problem = PGOProblem(grid(np.random.default_rng(7)))
        results.append(run(make(problem, max_iterations=30), problem))
    one, other = results
    assert (one.status, one.iterations) == (other.status, other.iterations)
    np.testing.assert_array_equal(one.poses.R, other.poses.R)
    np.testing.assert_array_equal(one.poses.t, other.poses.t)
    for column in ("objective", "primal_residual", "dual_residual"):
        np.testing.assert_array_equal(getattr(one.history, column), getattr(other.history, column))


# Limits are reported.


@pytest.fixture
def problem() -> PGOProblem:
    """Far enough from its start for a dozen steps of any method."""
    return PGOProblem(grid(np.random.default_rng(1)))


@pytest.fixture
def start(problem: PGOProblem) -> Poses:
    return random_poses(problem.num_poses, problem.d, 0)


# Settings.


@EVERY
@pytest.mark.parametrize("poses", [Poses.identity(26, 3), Poses.identity(27, 2)])
def test_a_start_of_another_size_is_refused(make: Make, poses: Poses, problem: PGOProblem) -> None:
    with pytest.raises(GraphError, match="give one pose for every pose of the graph"):
        run(make(problem), problem, poses)


def fields_of_settings() -> list[Any]:
    """Fields of public settings that have defaults, without those of protocols and arrays."""
    records = {"Traffic"}  # not settings, although they check what they are made of
    kinds = [getattr(solvers, name) for name in solvers.__all__ if name not in records]
    kinds = [
        kind for kind in kinds if dataclasses.is_dataclass(kind) and hasattr(kind, "__post_init__")
    ]
    every = [(kind, field) for kind in kinds for field in dataclasses.fields(kind)]
    open_ones = ("engine", "r_step", "known", "idle", "soc", "changer", "only", "contenders")
    return [
        pytest.param(k, f.name, id=f"{k.__name__}-{f.name}")
        for k, f in every
        if f.name not in open_ones
    ]


@pytest.mark.parametrize(("kind", "field"), fields_of_settings())
def test_a_setting_of_another_type_is_named_where_it_is_made(kind: Any, field: str) -> None:
    others: dict[str, Any] = {
        Checkpoint: {"path": "there.json"},
        ExtendedSOC: {"changer": len},
    }.get(kind, {})
    with pytest.raises(SettingError, match=f"^{field} must be .*, got <object"):
        kind(**{**others, field: object()})


def default_settings() -> list[Any]:
    """Public settings that can be made without arguments."""
    kinds = [getattr(door, name) for door in (pgo_models, solvers) for name in door.__all__]
    kinds = [kind for kind in kinds if isinstance(kind, type) and dataclasses.is_dataclass(kind)]
    # A change of the model holds expressions of cvxpy, whose equality is a constraint.
    kinds = [kind for kind in kinds if kind is not pgo_models.ModelChange]
    return [kind for kind in kinds if all(map(has_default, dataclasses.fields(kind)))]


def has_default(field: dataclasses.Field[Any]) -> bool:
    has_value = field.default is not dataclasses.MISSING
    return has_value or field.default_factory is not dataclasses.MISSING


@pytest.mark.parametrize("kind", default_settings())
def test_settings_compare_by_value(kind: Any) -> None:
    assert kind() == kind()
    assert hash(kind()) == hash(kind())
    assert kind() != object()
    assert copy.deepcopy(kind()) == kind()


@pytest.mark.parametrize("kind", [GNC, PCM])
def test_settings_with_an_array_compare_by_value(kind: Any) -> None:
    known = np.array([True, False, True])
    settings_ = kind(known=known)
    assert settings_ == kind(known=known.copy())
    assert hash(settings_) == hash(kind(known=known.copy()))
    for other in (kind(), kind(known=~known), kind(known=known[:2])):
        assert settings_ != other
    assert settings_ != dataclasses.replace(settings_, quantile=0.5)


def test_settings_of_two_classes_differ() -> None:
    assert GNC() != PCM()
    assert FixedPenalty(2.0) == FixedPenalty(2.0) != FixedPenalty(3.0)


# By robots: what a state stands for is with them, and they are where the last order has left them.

# Every step is a stall, so that the penalties are chosen anew.
RESTLESS = MultiplierPenalty(stall_window=2, stall_ratio=1e-6, max_refreshes=2)
Begin = Callable[[Driver], tuple[Method[Any, Any, Any], Any]]


METHODS_OF_ROBOTS: dict[str, Begin] = {
    "substructured": lambda driver: (SubstructuredSOC(), driver),
    "substructured_restless": lambda driver: (SubstructuredSOC(SOC(penalty=RESTLESS)), driver),
    "substructured_balanced": lambda driver: (
        SubstructuredSOC(SOC(penalty=BalancedPenalty(scale=100.0))),
        driver,
    ),
    "consensus": lambda driver: (ConsensusSOC(), driver),
    "consensus_restless": lambda driver: (ConsensusSOC(SOC(penalty=RESTLESS)), driver),
    "consensus_leaderless": lambda driver: (ConsensusSOC(has_driver=False), driver),
    "asynchronous": lambda driver: (
        AsynchronousSOC(faults=Faults(loss=0.3, max_delay=2)),
        driver,
    ),
    "newton": lambda driver: (SubstructuredNewton(), driver),
    "staircase": lambda driver: (SubstructuredStaircase(), driver),
    "gnc": lambda driver: (SharedGNC(GNC(spread=None), 1e-9, 1e-13), driver),
}
BY_ROBOTS = pytest.mark.parametrize("begin", METHODS_OF_ROBOTS.values(), ids=METHODS_OF_ROBOTS)


@contextmanager
def by_default() -> Iterator[Engine]:
    yield InProcess(threads=2)


@contextmanager
def poses_left_to_the_driver() -> Iterator[Engine]:
    with leaving(2):
        yield InProcess()


PLACES = [by_default, poses_left_to_the_driver]
IN_EVERY_PLACE = pytest.mark.parametrize("place", PLACES, ids=lambda place: place.__name__)


@contextmanager
def driver_in(place: Any) -> Iterator[Driver]:
    """Driver and four robots at random poses."""
    problem = varied_problem(3, 24, 3)
    thresholds = np.ones(problem.graph.num_edges)
    with (
        place() as engine,
        closing(
            open_driver(problem, metis(problem.graph, 3), engine, thresholds=thresholds)
        ) as driver,
    ):
        driver.set_poses(random_poses(24, 3, 5))
        yield driver


def figures(method: Method[Any, Any, Any], problem: Any, state: Any) -> Any:
    measurement = method.measure(problem, state)
    return snapshot((measurement.objective, measurement.primal_residual, measurement.dual_residual))


@BY_ROBOTS
@IN_EVERY_PLACE
def test_a_list_of_states_by_robots_is_a_film(begin: Begin, place: Any) -> None:
    # Two steps from an old state give the two frames that followed it: the robots return.
    with driver_in(place) as driver:
        method, problem = begin(driver)
        film = list(islice(iterate(method, problem), 7))
        before = [snapshot(state) for state in film]
        for k in (4, 0, 3):
            following = method.step(problem, film[k])
            assert_same(figures(method, problem, following), figures(method, problem, film[k + 1]))
            after = method.step(problem, following)
            assert_same(figures(method, problem, after), figures(method, problem, film[k + 2]))
        assert_same([snapshot(state) for state in film], before)


@BY_ROBOTS
@IN_EVERY_PLACE
def test_a_step_twice_from_one_state_gives_the_same_state_twice(begin: Begin, place: Any) -> None:
    with driver_in(place) as driver:
        method, problem = begin(driver)
        state = method.init(problem, None)
        for _ in range(3):
            one = method.step(problem, state)
            other = method.step(problem, state)
            assert_same(figures(method, problem, other), figures(method, problem, one))
            assert one.k == other.k == state.k + 1
            state = other


def test_a_state_of_another_driver_is_refused() -> None:
    method = SubstructuredNewton()
    with driver_in(by_default) as driver, driver_in(by_default) as other:
        state = method.init(other, None)
        with pytest.raises(SettingError, match="not of a run with this driver; begin with"):
            method.step(driver, state)
        resumed = dataclasses.replace(state, moment=None)
        with pytest.raises(SettingError, match="not of a run with this driver; begin with"):
            method.step(other, resumed)
        assert method.step(other, method.init(other, resumed)).k == 1
