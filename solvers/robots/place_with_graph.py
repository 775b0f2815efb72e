"""The place where robots of one graph and a driver solve: each robot has the edges of its poses.

The calling process has the whole graph, cuts it into the robots' parts, and asks the result of
them. Robots hold the poses between two steps. What they are asked is counted (`solvers.carry`).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.problem import PGOProblem
from solvers.carry.ledger import BYTES_PER_NUMBER
from solvers.carry.process import DEFAULT_MEMORY, Engine
from solvers.robots.agent import Agent
from solvers.robots.driver import Driver
from solvers.soc.subgraph import middle_separator, split_graph


def open_driver(
    problem: PGOProblem,
    robots: Partition,
    engine: Engine,
    memory: float = DEFAULT_MEMORY,
    thresholds: Array | None = None,
) -> Driver:
    """Driver and robots for a problem.

    A robust solve gives the `thresholds`, (m,), of its edges.
    """
    subgraphs = split_graph(problem, robots, thresholds)
    if memory != 0:
        subgraphs = tuple(subgraph.for_driver() for subgraph in subgraphs)
    summaries = [subgraph.summary for subgraph in subgraphs]
    grounded = middle_separator(problem.graph, summaries)
    start = partial(engine.open, partial(Agent, backend=problem.backend), subgraphs)
    driver = Driver(summaries, problem.num_poses, start, memory, grounded, problem.backend)
    ledger = driver.network.ledger
    driver.network.ledger = replace(ledger, graph_bytes=bytes_of_edges(problem.graph))
    return driver


def bytes_of_edges(graph: PoseGraph) -> int:
    """Bytes of a list of all edges, each a relative pose and the two precisions of F."""
    return BYTES_PER_NUMBER * graph.num_edges * (graph.d * (graph.d + 1) // 2 + 2)
