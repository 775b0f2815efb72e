"""What a partition will cost the driver, before anything is solved, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass

from pgo_models.errors import MissingExtraError
from pgo_models.graphs.partitioning import Partition, PartitionMethod, partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.distributed.elimination_choice import ENOUGH_FLOPS, CoverSystem, choose_elimination
from solvers.soc.subgraph import split_graph

_WORTH_MOVING = 2.0  # another partition is advised if it takes so many times fewer operations


@dataclass(frozen=True)
class DriverForecast:
    """Cost of the driver's system, in which a pose has d + 1 unknowns.

    Parameters
    ----------
    num_poses : int
        Poses that the driver solves for.
    num_left : int
        Those that robots leave to it beside the vertex cover.
    flops : float
        Operations of a factorisation, `CoverSystem.flops`.
    flops_of_fronts : float
        The same if the robots eliminated all of their interiors.
    num_bytes : int
        Memory for the contributions of the robots and the factor, of driver and robots that hold
        fronts for it together.
    num_bytes_sent : int
        Bytes of the robots' Schur complements together.
    """

    num_poses: int
    num_left: int
    flops: float
    flops_of_fronts: float
    num_bytes: int
    num_bytes_sent: int

    def facts(self) -> list[tuple[str, str]]:
        """Labels and figures, as they are printed."""
        left = f", {self.num_left} of them left by robots" if self.num_left else ""
        return [
            ("driver", f"solves for {self.num_poses} poses{left}"),
            (
                "factorisation",
                f"{self.flops:.2g} operations, {1e-6 * self.num_bytes:.3g} MB; "
                f"robots send {1e-6 * self.num_bytes_sent:.3g} MB",
            ),
        ]


def forecast(robots: Partition, graph: PoseGraph) -> DriverForecast:
    """Compute what the driver of a solve by these robots will need.

    Parameters
    ----------
    robots : Partition
        Which robot owns which pose.
    graph : PoseGraph
        A connected graph.

    Returns
    -------
    DriverForecast
        Operations and bytes.

    Raises
    ------
    GraphError
        When the graph is not connected.
    SettingError
        When the partition is one of another number of poses.
    """
    subgraphs = split_graph(PGOProblem(graph, weighting=Weighting.ISOTROPIC), robots)
    before = CoverSystem.of([subgraph.summary for subgraph in subgraphs])
    chosen = choose_elimination(subgraphs)
    system = CoverSystem.of([subgraph.summary for subgraph in chosen])
    interface = system.interface((1, graph.d))
    return DriverForecast(
        num_poses=len(system.cover),
        num_left=len(system.cover) - len(before.cover),
        flops=system.flops,
        flops_of_fronts=before.flops,
        num_bytes=interface.num_bytes,
        num_bytes_sent=8 * sum(interface.num_entries),
    )


def advice(robots: Partition, graph: PoseGraph, expected: DriverForecast) -> str:
    """One line about what makes a solve by these robots cheaper, `expected` being their forecast.

    Parameters
    ----------
    robots : Partition
        Which robot owns which pose.
    graph : PoseGraph
        A connected graph.
    expected : DriverForecast
        What the driver will need.

    Returns
    -------
    str
        What to do, in terms of the options of `pgo solve`.
    """
    if expected.flops_of_fronts < ENOUGH_FLOPS:
        return "none needed, the driver has little to do"
    if robots.method is not PartitionMethod.METIS:
        try:
            balanced = partition(graph, robots.num_robots, PartitionMethod.METIS)
        except MissingExtraError as error:
            return str(error)
        other = forecast(balanced, graph)
        if _WORTH_MOVING * other.flops < expected.flops:
            return (
                f"areas of robots interleave; if poses may change robots, --split metis takes "
                f"{other.flops:.2g} operations for {other.num_poses} poses"
            )
    if expected.flops < ENOUGH_FLOPS:
        return "none needed, robots leave the driver the poses that would couple many others"
    return "fewer robots, or --driver-memory 0: CONSENSUS without a driver, and no certificate"
