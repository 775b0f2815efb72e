"""What the arguments of `pgo` name: graphs, edges, problems, poses and their times."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from pgo_models.errors import FileFormatError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.datasets import load, locate
from pgo_models.graphs.g2o import edge_places, read_g2o_poses
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.trajectories import read_kitti, read_times, read_tum
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting

Dropped = list[str] | None  # edges to leave out, by LINE or FILE:LINE


def load_graph(graph: str, unit_weights: bool, skip_unknown: bool = False, dropped: Dropped = None) -> PoseGraph:
    """Graph of a file, folder or data set, with its own weights or those of the paper, without the edges dropped."""
    loaded = load(graph, skip_unknown=skip_unknown)
    if dropped:
        loaded = loaded.without_edges(~kept_edges(graph, dropped)[0])
    return loaded.unit_weights() if unit_weights else loaded


def kept_edges(graph: str, dropped: Dropped) -> tuple[BoolArray, list[str]]:
    """Whether an edge is kept, (m,), and `file:line` of those that are; a SettingError where no edge has a name.

    An edge is named by its line, in a folder by `FILE:LINE`, with or without the folder.
    """
    path = locate(graph)
    if not (path.is_file() or path.is_dir()):
        raise SettingError(f"{graph} can be read only once; give it as a file to name its edges")
    with warnings.catch_warnings(action="ignore"):
        places = edge_places(path)
    kept = np.ones(len(places), dtype=bool)
    for name in dropped or ():
        named = [k for k, place in enumerate(places) if f"/{place}".endswith((f"/{name}", f":{name}"))]
        if len(named) != 1:
            what = "no edge is" if not named else f"{len(named)} edges are"
            raise SettingError(f"{what} at {name} of {graph}; name it LINE or FILE:LINE, as {places[0]}")
        kept[named] = False
    return kept, [place for place, is_kept in zip(places, kept, strict=True) if is_kept]


def pose_problem(graph: PoseGraph, unit_weights: bool, information: bool) -> PGOProblem:
    """Problem with the cost that was asked for; a SettingError where there are no information matrices."""
    if information and (unit_weights or graph.information is None):
        why = "--unit-weights takes them away" if unit_weights else f"{graph.name} has none"
        raise SettingError(f"--information asks for information matrices, and {why}; leave it out")
    return PGOProblem(graph, weighting=Weighting.INFORMATION if information else Weighting.ISOTROPIC)


def with_times(graph: PoseGraph, path: Path | None) -> PoseGraph:
    """Graph with the times in a file, one for every pose."""
    if path is None:
        return graph
    times = read_times(path)
    if len(times) != len(graph.bodies):
        problem = f"{len(times)} times, {graph.name} has {len(graph.bodies)} poses; give one each"
        raise FileFormatError(path, None, problem)
    return replace(graph, times=times)


def pose_named(graph: PoseGraph, name: int) -> int:
    """Pose with an id; a SettingError where there is none."""
    ids, found = graph.pose_ids, np.flatnonzero(graph.pose_ids == name)
    if not len(found):
        raise SettingError(f"{graph.name} has no pose {name} to anchor; its ids are from {ids.min()} to {ids.max()}")
    return int(found[0])


def estimated_poses(graph: PoseGraph, path: Path | None) -> Poses:
    """Poses in a file, else those that came with the graph."""
    if path is None:
        if graph.initial is None:
            raise SettingError(f"{graph.name} has no VERTEX line for every pose; give --estimate FILE")
        return graph.initial
    suffix = path.suffix.lower()
    if suffix == ".g2o":
        return read_g2o_poses(path, graph)
    if suffix in (".tum", ".txt"):
        found = read_tum(path, graph.d)
    elif suffix == ".kitti":
        found = read_kitti(path, graph.d)
    else:
        raise SettingError(f"cannot read {path}: no format has suffix {suffix!r}; use .g2o, .tum or .kitti")
    if found.num_poses != len(graph.in_files):
        known = f"{graph.name} has {len(graph.in_files)}, with its landmarks"
        raise FileFormatError(path, None, f"{found.num_poses} poses, {known}; give one each, or a .g2o file")
    return graph.completed(found)
