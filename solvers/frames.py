"""Which frame a solution is in: that of priors, of an anchor, of the estimate that came with the graph."""

from pgo_models.geometry.poses import Poses
from pgo_models.graphs.pose_graph import PoseGraph


def framed(poses: Poses, graph: PoseGraph, anchor: int | None) -> tuple[Poses, str, int]:
    """Poses in the frame of priors, anchor, first FIX line, estimate or pose 0; which it is; the pose held, or 0."""
    ids, reference = graph.pose_ids, graph.initial
    if graph.world is not None:
        unheeded = "; FIX lines are not minded beside them" if len(graph.fixed) else ""
        return poses.with_gauge_at(graph.world), f"that of the priors{unheeded}", graph.world
    held = anchor if anchor is not None else int(graph.fixed[0]) if len(graph.fixed) else None
    if held is None and reference is not None:
        return poses.aligned_to(reference), "aligned with the estimate that came with the graph", 0
    why = "as asked for" if anchor is not None else "by its FIX line"
    if anchor is None and len(graph.fixed) > 1:
        why += f"; those of {len(graph.fixed) - 1} other poses are not minded, F leaves one frame open"
    if held is not None and reference is not None:
        return poses.anchored_to(reference, held), f"pose {ids[held]} where the estimate has it, {why}", held
    if held is not None:
        return poses.with_gauge_at(held), f"pose {ids[held]} at the identity, {why}", held
    return poses.with_gauge_at(0), f"pose {ids[0]} at the identity", 0
