"""What crosses between robots that hold copies, rows of shared poses and sums, and its count."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from budget import examples
from graphs import DIMENSIONS, LOUD_NOISE, MILD_NOISE, SEEDS, varied_graph
from hypothesis import example, given, settings, strategies as st
from robots import (
    PARTITIONERS,
    Partitioner,
    Recording,
    arrays_in,
    bytes_of,
    contiguous,
    name_of,
)

from pgo_models import NoiseModel, PoseGraph, exp_map, grid, partition
from pgo_models.geometry.rotations import Array, tangent_dimension
from solvers import SOC, Coupling, Pipeline, Robots, Solution, solve
from solvers.carry.ledger import DRIVER
from solvers.robots import newton, poses as pose_orders
from solvers.robots.consensus import begin_copies
from solvers.robots.interface import Separators
from solvers.robots.proof import fits_part, move_proof, prove_interior
from solvers.soc.consensus_robot import ConsensusRobot

NOISES = st.sampled_from([MILD_NOISE, LOUD_NOISE])

Copies = ConsensusRobot
ROUNDS = (  # orders that are, or end, a round
    *(
        pose_orders.project,
        pose_orders.set_translations,
        newton.move,
        newton.evaluate_trial,
        newton.move_straight,
        fits_part,
        prove_interior,
    ),
    *(
        move_proof,
        pose_orders.adopt,
        begin_copies,
        Copies.penalize,
        Copies.solve,
        Copies.step,
        Copies.back_at_best,
    ),
)
ALL_REDUCES = (
    *(
        Copies.travel,
        Copies.multiplier_ratios,
        Copies.stiffness,
        Copies.start,
        Copies.solve,
        Copies.step,
    ),
)
OFF = ("set_poses", "cost", "result", "report_pairs", "report_terms")


class Watching(Recording):
    """Writes down, too, what robots find out about poses that another robot does not hold.

    The pose from which all are seen in a proof is no secret: pose 0, at the identity, is the
    inverse of it there.
    """

    def __init__(self, graph: PoseGraph) -> None:
        super().__init__()
        self.graph = graph

    def ask(self, order: Callable[[Any, Any], Any], requests: Sequence[Any]) -> list[Any]:
        answers = super().ask(order, requests)
        summaries = [share.summary for share in self.shares]
        grounded = -1
        if any(summary.coupled is not None for summary in summaries):
            separators = Separators.of(summaries)
            grounded = separators.cover[separators.middle]
        if name_of(order) == "describe":
            self.secrets: list[list[Array]] = [[] for _ in self.agents]
        for agent in self.agents:
            holder = agent.copies
            share = agent.subgraph
            if holder is not None:
                for other, secrets in zip(self.shares, self.secrets, strict=True):
                    hidden = ~np.isin(share.poses, other.poses) & (share.poses != grounded)
                    rows = np.concatenate([hidden, np.repeat(hidden, share.graph.d)])
                    block = holder.state.block
                    known = (holder.state.X, *((block.omega, block.s) if block is not None else ()))
                    secrets += [values[rows].ravel() for values in known]
        return answers


Engine = TypeVar("Engine", bound=Recording)


def solved(
    seed: int,
    n: int,
    d: int,
    partitioner: Partitioner,
    noise: NoiseModel,
    engine: Engine,
    soc: SOC | None = None,
) -> tuple[Solution, Engine]:
    return solved_graph(varied_graph(seed, n, d, noise), seed, partitioner, engine, soc)


def solved_graph(
    graph: PoseGraph, seed: int, partitioner: Partitioner, engine: Engine, soc: SOC | None = None
) -> tuple[Solution, Engine]:
    parts = partitioner(graph, seed)
    soc = replace(
        soc if soc is not None else SOC(tolerance=1e-4), coupling=Coupling.CONSENSUS, robots=parts
    )
    pipeline = Pipeline(soc=soc, other_starts=False, staircase=None)
    return solve(graph, pipeline, robots=Robots(parts, engine=engine)), engine


@settings(max_examples=examples(12))
@example(seed=624587, n=10, d=3, noise=LOUD_NOISE, partitioner=contiguous)  # terms are searched
@given(seed=SEEDS, n=st.integers(3, 16), d=DIMENSIONS, noise=NOISES, partitioner=PARTITIONERS)
def test_the_ledger_counts_what_was_sent(
    seed: int, n: int, d: int, noise: NoiseModel, partitioner: Partitioner
) -> None:
    solution, engine = solved(seed, n, d, partitioner, noise, Recording())
    ledger = solution.ledger
    number = len(engine.shares)
    sent = np.zeros((2, number))
    received = np.zeros((2, number))
    links: dict[tuple[int, int], int] = {}
    assert engine.log[0][0] == "describe"  # of setting up, which is off the ledger
    for order, down, up in engine.log[1:]:
        if order in OFF:
            continue
        for robot in range(number):
            for name, value in arrays_in(down[robot]):
                # from robots: counted where it is sent
                received[:, robot] += bytes_of(value) * (">" not in name)
            for name, value in arrays_in(up[robot]):
                if name == "measured":
                    continue
                sent[:, robot] += bytes_of(value)
                if ">" in name:
                    link = robot, int(name.partition(">")[2])
                    received[:, link[1]] += bytes_of(value)
                    links[link] = links.get(link, 0) + bytes_of(value)
    np.testing.assert_array_equal(ledger.bytes_sent, sent[0])
    np.testing.assert_array_equal(ledger.bytes_received, received[0])
    between = {
        (a, b): size for a, b, _, size in zip(*(x.tolist() for x in ledger.by_link()), strict=True)
    }
    assert {link: size for link, size in between.items() if DRIVER not in link} == links
    assert ledger.rounds == engine.times(*ROUNDS)
    assert ledger.all_reduces == engine.times(*ALL_REDUCES)


def test_rounds_of_a_whole_solve_are_as_documented() -> None:
    graph = grid(np.random.default_rng(0))
    engine = Recording()
    parts = partition(graph, 3)
    soc = SOC(robots=parts, tolerance=2e-3)
    solution = solve(graph, Pipeline(soc=soc), robots=Robots(parts, engine=engine))
    _, stage, _ = solution.stages
    assert engine.times(begin_copies, Copies.back_at_best) == 1  # no refresh, no raise
    rounds = [record.measurement.rounds for record in stage.history.records]
    assert rounds == [4, *range(6, 5 + len(rounds))]
    # 2 to start, 2 for poses and penalties, 1 before the first step and 1 a step, 2 for the result
    # of SOC, 2 a move of Newton, 2 for the proof.
    assert (
        solution.ledger.rounds
        == 2 + (2 + 1 + stage.iterations + 2) + 2 * engine.times(newton.move) + 2
    )
    assert solution.ledger.all_reduces == 3 + 1 + stage.iterations


def measured_twice(graph: PoseGraph, rng: np.random.Generator) -> PoseGraph:
    """Graph with a second measurement of every edge.

    Without it a pose beyond a bridge, seen from it, is a measurement.
    """
    shape = graph.num_edges, tangent_dimension(graph.d)
    twice = {name: np.tile(getattr(graph, name), 2) for name in ("i", "j", "kappa", "tau")}
    R_ij = np.concatenate([graph.R_ij, graph.R_ij @ exp_map(0.1 * rng.standard_normal(shape))])
    t_ij = np.concatenate([graph.t_ij, graph.t_ij + 0.1 * rng.standard_normal(graph.t_ij.shape)])
    return replace(graph, R_ij=R_ij, t_ij=t_ij, **twice)


@example(seed=6431187, n=6, d=2, noise=MILD_NOISE, partitioner=contiguous)
@settings(max_examples=examples(10))
@given(seed=SEEDS, n=st.integers(6, 16), d=DIMENSIONS, noise=NOISES, partitioner=PARTITIONERS)
def test_no_robot_is_sent_a_pose_that_it_does_not_hold_or_an_edge_between_such_poses(
    seed: int, n: int, d: int, noise: NoiseModel, partitioner: Partitioner
) -> None:
    graph = measured_twice(varied_graph(seed, n, d, noise), np.random.default_rng(seed))
    _, engine = solved_graph(graph, seed, partitioner, Watching(graph), SOC(max_iterations=4))
    for share, secrets in zip(engine.shares, engine.secrets, strict=True):
        theirs = ~np.isin(graph.i, share.poses) & ~np.isin(graph.j, share.poses)
        edges = [graph.R_ij[theirs], graph.t_ij[theirs], graph.kappa[theirs], graph.tau[theirs]]
        secret = np.concatenate([*secrets, *(np.ravel(values) for values in edges)])
        secret = secret[~np.isin(np.abs(secret), [0.0, 1.0])]  # which anything may be
        told = [
            np.ravel(value)
            for _, down, _ in engine.log
            for _, value in arrays_in(down[share.robot])
        ]
        assert not np.isin(secret, np.concatenate([np.zeros(0), *told])).any()
