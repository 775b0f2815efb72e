"""Graphs as text with a chosen format of numbers, as other programs write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pgo_models import PGOProblem, PoseGraph, chordal_start, partition
from pgo_models.graphs.g2o_rows import numbers_of
from pgo_models.graphs.pose_graph import isotropic_information


def written_text(graph: PoseGraph, form: str) -> str:
    """EDGE lines whose measurements are written as `form` says; the matrices have all digits."""
    kind = "SE2" if graph.d == 2 else "SE3:QUAT"
    information = graph.information
    if information is None:
        information = isotropic_information(graph.kappa, graph.tau, graph.d)
    triangle = np.triu_indices(information.shape[1])
    lines = []
    for e, numbers in enumerate(numbers_of(graph.R_ij, graph.t_ij)):
        measured = _words(numbers.tolist(), form)
        matrix = _words(information[e][triangle].tolist(), "%.17g")
        lines.append(f"EDGE_{kind} {graph.i[e]} {graph.j[e]} {measured} {matrix}")
    return "\n".join(lines) + "\n"


def _words(numbers: list[float], form: str) -> str:
    return " ".join(form % number for number in numbers)


def write_robot_files(graph: PoseGraph, folder: Path, form: str) -> Path:
    """A file for each of three robots, with its poses and all edges that touch them."""
    robot = partition(graph, num_robots=3).robot
    folder.mkdir()
    lines = written_text(graph, form).splitlines()
    truth = chordal_start(PGOProblem(graph))
    kind = "SE2" if graph.d == 2 else "SE3:QUAT"
    rows = numbers_of(truth.R, truth.t)
    for own in range(3):
        text = [
            f"VERTEX_{kind} {pose} {_words(rows[pose].tolist(), '%.17g')}"
            for pose in np.flatnonzero(robot == own)
        ]
        touches = (robot[graph.i] == own) | (robot[graph.j] == own)
        text += [lines[e] for e in np.flatnonzero(touches)]
        (folder / f"{own}.g2o").write_text("\n".join(text) + "\n")
    return folder
