"""Files that a solution is written to: their suffix names the format."""

from pathlib import Path

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.files import check_writable
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.g2o import (
    check_g2o_folder,
    trajectories_of_robots,
    write_g2o,
    write_g2o_folder,
)
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.trajectories import write_kitti, write_tum
from pgo_models.plots.style import check_installed, is_picture


def check_format(path: Path) -> None:
    """Raise what `Solution.save` would for the suffix of a path.

    That is a SettingError for an unknown one, or an error where matplotlib is missing.
    """
    suffix = path.suffix.lower()
    if is_picture(path):
        check_installed(path)
    elif suffix not in ("", ".g2o", ".tum", ".txt", ".kitti", ".json"):
        known = ".g2o, .tum, .kitti, .json, .png, .svg or .pdf"
        raise SettingError(f"cannot write {path}: no format has suffix {suffix!r}; use {known}")


def check_target(path: Path, num_robots: int) -> None:
    """Raise what `Solution.save` would for a path, before there is a solution of these robots."""
    check_format(path)
    if path.suffix == "":
        check_g2o_folder(path, num_robots)
    else:
        check_writable(path)


def write_poses(graph: PoseGraph, poses: Poses, path: Path) -> None:
    """Write poses of a graph as a g2o file, a folder of such, or a trajectory."""
    suffix = path.suffix.lower()
    if suffix == ".g2o":
        write_g2o(graph, path, poses)
    elif suffix == "":
        write_g2o_folder(graph, path, poses)
    elif suffix == ".kitti":
        write_kitti(poses[graph.bodies], path)
    else:
        write_tum(poses[graph.bodies], path, graph.times)
        if graph.num_robots > 1:
            _write_tum_of_robots(graph, poses, path)


def _write_tum_of_robots(graph: PoseGraph, poses: Poses, path: Path) -> None:
    """Write a trajectory for each robot beside that of all, NAME.ROBOT.tum.

    The time of a pose is that of the graph, or the number that its robot has for it.
    """
    time_of_pose = np.zeros(graph.num_poses)
    if graph.times is not None:
        time_of_pose[graph.bodies] = graph.times
    for name, own, numbers in trajectories_of_robots(graph):
        times = numbers.astype(float) if graph.times is None else time_of_pose[own]
        write_tum(poses[own], path.with_name(f"{path.stem}.{name}{path.suffix}"), times)
