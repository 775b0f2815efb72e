"""Graduated non-convexity by robots with own files, from what pairwise consistency has found.

The robots hold more edges again, each with the threshold of its cost, at the poses that were found
without them. From there they run the algorithm of `solvers.robust.gnc`. The edges within their
thresholds at the end are kept if the truncated cost has fallen, and those that robots need to hold
together; else those that were kept before, or agree pairwise. Where the poses are of a certified
map, the edges that come back are those near it: the others begin a short schedule without weight,
and would join all robots to each other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.errors import FAILURES, GraphError
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.pose_graph import least_tree
from solvers.carry.counted_pool import Count
from solvers.loop import RunMonitor
from solvers.place import BROKEN_OFF
from solvers.result import Stage
from solvers.robots import current_poses
from solvers.robots.driver import Driver
from solvers.robots.own_file import Border
from solvers.robots.revision_of_robot import (
    ComesBack,
    Links,
    TakenBack,
    go_back,
    go_to_solved,
    judge_near,
    keep,
    take_back,
    tell_cover,
    tell_kept,
    tell_links,
    tell_solved,
)
from solvers.robots.reweigh import SharedGNC, stage_of
from solvers.robots.reweighting import sum_truncated
from solvers.robots.setup import OpenedFiles
from solvers.robust.gnc import GNC


@dataclass(frozen=True, eq=False)
class Revision:
    """What a run has made of the edges: robots that hold those kept, at poses found for them."""

    opened: OpenedFiles
    stage: Stage
    is_better: bool


@dataclass(frozen=True, eq=False)
class Pass:
    """A run with these settings that judges the edges that come back.

    From poses of a map, which most edges fit, one short schedule will do.
    """

    gnc: GNC
    comes_back: ComesBack
    has_map: bool
    is_first: bool


def revised(opened: OpenedFiles, job: Pass, monitor: RunMonitor) -> Revision:
    """Judge edges by a run from the poses that the robots keep."""
    network = opened.driver.network
    objective = opened.driver.current.objective
    borders = network.ask(take_back, _taken_back(opened, job), Count.PIGGYBACKED)
    try:
        stage, kept = _judged(opened, borders, job, monitor)
    except FAILURES:
        stage, kept = Stage.failure("GNC", objective), None
    if kept is not None:
        return Revision(kept, stage, is_better=True)
    nothing = [None] * network.ledger.num_robots
    parts = network.ask(go_back, nothing, Count.PIGGYBACKED)
    return Revision(opened.with_parts(parts), stage, is_better=False)


def _judged(
    opened: OpenedFiles, borders: Sequence[Border], job: Pass, monitor: RunMonitor
) -> tuple[Stage, OpenedFiles | None]:
    """What a run did, and the robots with the edges that it keeps, if it has found a better map.

    Robots have taken edges back, and told their borders.
    Maps are compared by their truncated costs, with thresholds at the scale of the errors.
    """
    network = opened.driver.network
    gnc = job.gnc
    driver = opened.with_edges(borders, 0).driver
    go_to_poses_found(driver)
    before = _truncated_cost(driver, opened.threshold_scale)
    finished = monitor.run(SharedGNC.of_files(gnc, driver, job.has_map), driver)
    stage = stage_of(gnc, finished)
    if finished.status in BROKEN_OFF:
        return stage, None
    driver.return_to(finished.state.edges.newton.moment)
    if not _truncated_cost(driver, opened.threshold_scale) < before:
        return stage, None
    scale = finished.state.schedule.scale
    covers = [(scale, cover) for cover in driver.poses_of_cover()]
    links = network.ask(tell_links, covers, Count.ROUND)
    kept_by_counters = network.ask(tell_kept, holding(links), Count.PIGGYBACKED)
    parts = network.ask(keep, network.exchange(kept_by_counters), Count.PIGGYBACKED)
    try:
        return stage, opened.with_parts(parts)
    except GraphError:  # they leave poses of a robot apart
        return stage, None


def _taken_back(opened: OpenedFiles, job: Pass) -> list[TakenBack]:
    """What every robot takes back; neighbours agree on what is near the map."""
    network = opened.driver.network
    num_robots = network.ledger.num_robots
    near: Sequence[Mapping[int, BoolArray]] = [{}] * num_robots
    if job.comes_back is ComesBack.NEAR:
        solved_poses = network.ask(tell_solved, [None] * num_robots, Count.PIGGYBACKED)
        requests = [
            (received, opened.weighting, job.gnc.quantile)
            for received in network.exchange(solved_poses)
        ]
        near = network.exchange(network.ask(judge_near, requests, Count.PIGGYBACKED))
    return [
        TakenBack(job.comes_back, opened.weighting, job.gnc.quantile, job.is_first, received)
        for received in near
    ]


def holding(links: Sequence[Links]) -> list[BoolArray]:
    """Which links robots need, so that those within their thresholds leave none apart.

    They are those of a tree with the smallest ratios.
    """
    owners = np.concatenate([part.owners for part in links])
    ratio = np.concatenate([part.ratio for part in links])
    is_held = np.zeros(len(ratio), dtype=bool)
    is_held[least_tree(owners[:, 0], owners[:, 1], len(links), ratio)] = True
    ends = np.cumsum([len(part.ratio) for part in links])[:-1]
    return [np.asarray(part) for part in np.split(is_held, ends)]


def go_to_poses_found(driver: Driver) -> None:
    """Go to the poses that the robots have found of their own."""
    network = driver.network
    nothing = [None] * network.ledger.num_robots
    R = driver.current.R.copy()
    t = driver.current.t.copy()
    for on_cover in network.ask(tell_cover, nothing, Count.ROUND):
        positions = driver.positions(on_cover.numbers)
        R[positions] = on_cover.poses.R
        t[positions] = on_cover.poses.t
    driver.current = replace(driver.current, R=R, t=t)
    network.ask(go_to_solved, driver.poses_of_cover(), Count.PIGGYBACKED)
    answers = driver.ask(current_poses.evaluate, None, Count.PIGGYBACKED)
    driver.current = driver.with_cost(driver.current, answers)
    driver.choose_cost(final=True)


def _truncated_cost(driver: Driver, scale: float) -> float:
    """Truncated cost of all edges at the current poses, with scaled thresholds."""
    return math.fsum(driver.ask(sum_truncated, scale))
