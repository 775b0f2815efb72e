"""The frame of the answer: the cost is the same in all, so that one has to be chosen."""

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.graphs.pose_graph import PoseGraph


def choose_gauge(poses: Poses, graph: PoseGraph, anchor: int | None) -> tuple[Poses, str, int]:
    """Poses in the frame of priors, anchor, first FIX line, estimate or pose 0.

    Returned are the moved poses, a sentence on their frame, and the pose that it is held by, 0
    where there is none.
    """
    reference = graph.initial
    if graph.world is not None:
        ignored = "; FIX lines are ignored beside them" if len(graph.fixed) else ""
        frame = f"that of the priors{ignored}"
        moved = graph.in_frame_of_priors(poses)
        if graph.has_far_priors:
            half_a_digit = np.spacing(np.abs(moved.t).max()) / 2.0
            frame += f"; doubles have coordinates so far from zero to {half_a_digit:.1e} m"
        return moved, frame, graph.world
    held = anchor
    why = "as asked for"
    if anchor is None and len(graph.fixed):
        held = int(graph.fixed[0])
        why = "by its FIX line"
    if held is None:
        if reference is not None:
            frame = "aligned with the estimate that came with the graph"
            return poses.aligned_to(reference), frame, 0
        return poses.with_gauge_at(0), f"pose {graph.pose_ids[0]} at the identity", 0
    name = f"pose {graph.pose_ids[held]}"
    if reference is not None:
        moved = poses.anchored_to(reference, held)
        return moved, f"{name} where the estimate has it, {why}", held
    return poses.with_gauge_at(held), f"{name} at the identity, {why}", held
