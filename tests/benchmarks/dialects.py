"""What pgo makes of pose graphs as people have them: every form in which lines are written, in
files that this script writes itself, and the data files that GTSAM comes with (extra `peers`).

    python tests/benchmarks/dialects.py [--seconds 60] [--gtsam] [FILE ..]

Without arguments, small files of every form, and factor graphs of GTSAM where it is installed. With
`--gtsam`, all files of GTSAM's folder `Data`;
else those that are named. A row has what the file holds, the verdict of `solve` and the proven gap,
its CPU seconds, and what was assumed in reading, or why the file is refused. Of the files of this
script it also has the reading that `pgo doctor` names. A solve ends after so many seconds at its
best poses.
"""

from __future__ import annotations

import argparse
import gzip
import importlib.util
import json
import os
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"

import numpy as np

import pgo_models as pgo
import solvers
from pgo_models import PGOError
from pgo_models.figures import rounded_up
from solvers import compare_readings

HEAD = (
    "| file | poses | points | edges | cost | gap | verdict | CPU s | assumed, or why refused |\n"
    "|---|---|---|---|---|---|---|---|---|"
)
SHOWN = 300  # characters of a reason
STD = 0.02  # noise of the files of this script, metres and half of it in radians


def folder_of_gtsam() -> Path:
    """Folder with the data files that GTSAM comes with; it is found without an import."""
    spec = importlib.util.find_spec("gtsam")
    if spec is None or spec.origin is None:
        raise SystemExit("gtsam is not installed; run: pip install 'pgo-splitting[peers]'")
    return Path(spec.origin).parent / "Data"


def walk(d: int, folder: Path) -> list[str]:
    """Lines of a walk on a lattice, as g2o writes them."""
    noise = pgo.NoiseModel(translation_std=STD, rotation_std=0.5 * STD)
    graph = pgo.grid_world(1, 60, np.random.default_rng(d), d=d, noise=noise)
    pgo.write_g2o(graph, folder / "walk.g2o")
    return (folder / "walk.g2o").read_text().splitlines()


def changed(lines: list[str], change, which: str = "EDGE") -> list[str]:
    """Lines of which some have other words behind the tag."""
    result = []
    for line in lines:
        tag, *words = line.split()
        if not tag.startswith(which):
            result.append(line)
            continue
        result.append(" ".join(change([tag, *words])))
    return result


def is_closure(words: list[str]) -> bool:
    return abs(int(words[1]) - int(words[2])) > 1


def swapped(words: list[str]) -> list[str]:
    return [words[0], words[2], words[1], *words[3:]] if is_closure(words) else words


def in_degrees(words: list[str]) -> list[str]:
    return [*words[:5], repr(float(np.rad2deg(float(words[5])))), *words[6:]]


def in_toro_order(words: list[str]) -> list[str]:
    xx, xy, xt, yy, yt, tt = words[6:]
    return [*words[:6], xx, xy, yy, tt, xt, yt]


def inverted(words: list[str]) -> list[str]:
    """Diagonal matrices as covariances."""
    return [*words[:6], *(repr(1.0 / float(word)) if float(word) else word for word in words[6:])]


def complete(words: list[str]) -> list[str]:
    xx, xy, xt, yy, yt, tt = words[6:]
    return [*words[:6], xx, xy, xt, xy, yy, yt, xt, yt, tt]


def switchable(words: list[str]) -> list[str]:
    if not is_closure(words):
        return words
    return ["EDGE_SE2_SWITCHABLE", *words[1:3], "9999", *words[3:]]


def forms(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Names and lines of small files, one of every form."""
    plane = walk(2, folder)
    space = walk(3, folder)
    yield "plain_2d", plane
    yield "plain_3d", space
    yield "no_information", changed(plane, lambda words: words[:6])
    yield "complete_matrices", changed(plane, complete)
    yield "tutorial", [f"TUTORIAL_{line}" for line in plane]
    yield "online", [f"ONLINE_{line}" for line in space]
    yield "without_quat", [line.replace(":QUAT", "") for line in space]
    switches = ["VERTEX_SWITCH 9999 1", "EDGE_SWITCH_PRIOR 9999 1 1.0"]
    yield "switchable", switches + changed(plane, switchable)
    fixes = [f"EDGE_SE3_PRIORXYZ {k} {k} {k % 3} {k % 5} 1 0 0 1 0 1" for k in range(0, 60, 7)]
    yield "hdl_priors", [*space, *fixes, "EDGE_SE3_PRIORQUAT 0 1 0 0 0 9 0 0 9 0 9"]
    laser = ["ROBOTLASER1 0 -1.57 3.14 0.01 30 0.1 0 2 1.0 2.0"]
    yield "kernels_and_data", laser + changed(plane, lambda words: [*words, "Huber", "1.0"])
    yield "comments", ["// a walk", *(f"{line} # line" for line in plane)]
    yield "fortran", [line.replace("e-", "D-") for line in plane]
    yield "decimal_comma", [line.replace(".", ",") for line in plane]
    yield "repeated_vertices", plane + [line for line in plane if line.startswith("VERTEX")]
    yield "several_fix", ["FIX 0", "FIX 7", *plane]
    yield "missing_vertex", plane[1:]
    yield "isolated_vertex", ["VERTEX_SE2 777 0 0 0", *plane]
    yield "toro_order", changed(plane, in_toro_order)
    yield "closures_reversed", changed(plane, swapped)
    yield "degrees", changed(plane, in_degrees)
    yield "covariances", changed(plane, inverted)
    gps = [f"EDGE_PRIOR_SE2_XY {k} {k} 0 1 0 1" for k in range(5)]
    yield "gps_alone", gps
    yield from partial_forms(plane, space)
    yield from exported_forms(plane, space)


def partial_forms(plane: list[str], space: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Files with measurements that do not measure every direction."""
    places = {}
    for line in space:
        if line.startswith("VERTEX"):
            _, name, *numbers = line.split()
            places[int(name)] = numbers
    every_tenth = range(0, 60, 10)
    heights = "0 0 0 0 0 25"
    offset = "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"
    fixes = [f"EDGE_SE3_XYZ_PRIOR {k} 0 {' '.join(places[k][:3])}" for k in every_tenth]
    yield "gps_without_height", [offset, *space, *(f"{fix} 4 0 0 4 0 0" for fix in fixes)]
    yield "barometer", [offset, *space, *(f"{fix} {heights}" for fix in fixes)]
    level = "0 0 0 0 0 0 1 " + " ".join("0" for _ in range(15))
    gravity = [f"EDGE_SE3_PRIOR {k} 0 {level} 900 0 0 900 0 0" for k in every_tenth]
    yield "gravity", [offset, *space, *gravity]
    up = "0 0 1 0.01 0.02 1 900 0 0 900 0 900"
    level_fixes = [f"EDGE_SE3_PRIORXY {k} {' '.join(places[k][:2])} 4 0 4" for k in every_tenth]
    yield "hdl_fixes_without_height", [*space, *level_fixes]
    yield "gravity_vectors", [*space, *(f"EDGE_SE3_PRIORVEC {k} {up}" for k in every_tenth)]
    compass = [f"EDGE_PRIOR_SE2 {k} 0 0 0 0 0 0 0 0 2500" for k in range(0, 60, 30)]
    yield "compass", [*plane, *compass]
    yield "corridor", changed(plane, without_x)
    yield "single_prior", [*plane, "EDGE_PRIOR_SE2 0 5 5 1 1e12 0 0 1e12 0 1e12"]
    yield "indefinite", changed(plane, lambda words: [*words[:7], "1e9", *words[8:]])


def without_x(words: list[str]) -> list[str]:
    return [*words[:6], "0", "0", "0", *words[9:]] if is_closure(words) else words


def exported_forms(plane: list[str], space: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Files as other programs export them."""
    fixes = [f"EDGE_POINTXYZ_PRIOR {k} {k % 7} {k % 5} 0 1 0 0 1 0 1" for k in range(0, 60, 9)]
    yield "rtabmap_fixes", [*space, *fixes]
    edges = [line for line in space if line.startswith("EDGE")]
    yield "rtabmap_fixes_of_edges_alone", [*edges, *fixes]
    key = 103 << 56
    robots = changed(space, lambda words: named_by_labels(words, key), "")
    yield "labeled_symbols", robots
    edges = [line.split()[1:] for line in plane if line.startswith("EDGE")]
    header = "i,j,x,y,theta,xx,xy,xt,yy,yt,tt"
    yield "table", [header, *(",".join(words) for words in edges)]
    yield (
        "table_with_deviations",
        ["# stamp from to dx dy yaw sigma_x sigma_y sigma_yaw", *map(with_deviations, edges)],
    )
    cameras = changed(changed(space, with_rotation_first), as_camera)
    yield "cameras", [line.replace("VERTEX_SE3:QUAT", "VERTEX_SE3:EXPMAP") for line in cameras]
    yield "similarities", changed(space, as_similarity)
    yield "open3d.json", [as_open3d(space)]
    yield "EGs.txt", [as_view(line) for line in space if line.startswith("EDGE")]
    named = [as_view(line, "image_{:03}.jpg") for line in space if line.startswith("EDGE")]
    yield "relative_poses.txt", named
    yield "rotation_first", changed(space, with_rotation_first)
    yield (
        "reversed_rotation_first",
        changed(
            changed(space, with_rotation_first),
            lambda words: [words[0], words[2], words[1], *words[3:]],
        ),
    )


def with_deviations(words: list[str]) -> str:
    """A row of a table: a time, the two poses, the measurement and its standard deviations."""
    precisions = np.array([words[5], words[8], words[10]], dtype=float)
    return " ".join(["0.1", *words[:5], *map(repr, (precisions**-0.5).tolist())])


def named_by_labels(words: list[str], key: int) -> list[str]:
    count = 2 if words[0].startswith("EDGE") else 1
    ids = [str(key | (65 + int(name) // 30) << 48 | int(name)) for name in words[1 : 1 + count]]
    return [words[0], *ids, *words[1 + count :]]


def as_camera(words: list[str]) -> list[str]:
    return ["EDGE_SE3:EXPMAP", *words[1:]]


def as_similarity(words: list[str]) -> list[str]:
    """Edges as logarithms of similarities of scale 1, which are about those of their poses."""
    numbers = np.array(words[3:10], dtype=float)
    w = pgo.log_map(rotation_of(numbers)[None])[0]
    angle = np.linalg.norm(w)
    W = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    V = np.eye(3)
    if angle > 0.0:
        V += (1 - np.cos(angle)) / angle**2 * W + (angle - np.sin(angle)) / angle**3 * W @ W
    u = np.linalg.solve(V, numbers[:3])
    diagonal = np.array([float(words[10 + place]) for place in (15, 18, 20, 0, 6, 11)])
    matrix = np.diag([*diagonal, 1.0])[np.triu_indices(7)]
    shown = map(repr, [*w.tolist(), *u.tolist(), 0.0, *matrix.tolist()])
    return ["EDGE_SIM3:EXPMAP", *words[1:3], *shown]


def rotation_of(numbers: np.ndarray) -> np.ndarray:
    """Rotation of x y z qx qy qz qw."""
    x, y, z, w = numbers[3:]
    q = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2.0 * w * q + 2.0 * q @ q


def as_open3d(lines: list[str]) -> str:
    """A pose graph of Open3D, whose edges lead from the later pose to the earlier one."""
    nodes = []
    edges = []
    for line in lines:
        tag, *words = line.split()
        is_edge = tag.startswith("EDGE")
        start = 2 if is_edge else 1
        numbers = np.array(words[start : start + 7], dtype=float)
        X = np.eye(4)
        X[:3, :3] = rotation_of(numbers)
        X[:3, 3] = numbers[:3]
        if not is_edge:
            nodes.append({"pose": X.T.ravel().tolist()})
            continue
        upper = np.zeros((6, 6))
        upper[np.triu_indices(6)] = np.array(words[9:], dtype=float)
        matrix = np.roll(upper + np.triu(upper, 1).T, 3, axis=(0, 1))
        edge = {"source_node_id": int(words[1]), "target_node_id": int(words[0])}
        edge |= {"uncertain": is_closure(line.split()), "confidence": 1.0}
        edge |= {"transformation": X.T.ravel().tolist(), "information": matrix.ravel().tolist()}
        edges.append(edge)
    return json.dumps({"class_name": "PoseGraph", "nodes": nodes, "edges": edges})


def as_view(line: str, name: str = "") -> str:
    """A view of EGs.txt; with names one of GLOMAP, a quaternion that leads to the second camera."""
    _, i, j, *words = line.split()
    numbers = np.array(words[:7], dtype=float)
    direction = (numbers[:3] / np.linalg.norm(numbers[:3])).tolist()
    if not name:
        shown = [*rotation_of(numbers).ravel().tolist(), *direction]
        return " ".join([i, j, *map(repr, shown)])
    x, y, z, w = numbers[3:].tolist()
    names = [name.format(int(i)), name.format(int(j))]
    return " ".join([*names, *map(repr, [w, -x, -y, -z, *direction])])


def factor_graphs() -> Iterator[tuple[str, Callable[[], pgo.PoseGraph]]]:
    """Factor graphs of GTSAM, and how they are read; none where it is not installed."""
    if importlib.util.find_spec("gtsam") is None:
        return
    import gtsam

    rng = np.random.default_rng(0)
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.05)
    huber = gtsam.noiseModel.mEstimator.Huber.Create(1.345)
    turns = gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3)
    poses = [gtsam.Pose3(turns.compose(gtsam.Rot3.Rz(k)), [k % 4, k % 3, k % 5]) for k in range(20)]
    pairs = [(k, k + 1) for k in range(19)] + [(k, k + 5) for k in range(0, 15, 3)]

    def cycles(noise) -> gtsam.NonlinearFactorGraph:
        factors = gtsam.NonlinearFactorGraph()
        for i, j in pairs:
            measured = poses[i].between(poses[j]).retract(0.05 * rng.normal(size=6))
            factors.add(gtsam.BetweenFactorPose3(i, j, measured, noise))
        return factors

    robust = cycles(gtsam.noiseModel.Robust.Create(huber, noise))
    attitudes = cycles(noise)
    antennas = cycles(noise)
    constrained = cycles(noise)
    constrained.add(gtsam.PriorFactorPose3(0, poses[0], gtsam.noiseModel.Constrained.All(6)))
    for k in range(0, 20, 4):
        up = gtsam.Unit3(poses[k].rotation().unrotate(np.array([0.0, 0.0, 1.0])))
        tilt = gtsam.noiseModel.Isotropic.Sigma(2, 0.02)
        attitudes.add(gtsam.AttitudeFactorPose3(k, gtsam.Unit3([0, 0, 1]), tilt, up))
        arm = np.array([0.3, 0.0, 1.0])
        fix = poses[k].transformFrom(arm) + 0.1 * rng.normal(size=3)
        sigmas = gtsam.noiseModel.Diagonal.Sigmas([0.1, 0.1, 0.3])
        antennas.add(gtsam.GPSFactorArm(k, fix, arm, sigmas))
    yield "gtsam, robust", partial(pgo.from_gtsam, robust)
    yield "gtsam, attitudes", partial(pgo.from_gtsam, attitudes)
    yield "gtsam, GPS at an arm", partial(pgo.from_gtsam, antennas)
    yield "gtsam, constrained prior", partial(pgo.from_gtsam, constrained)


def with_rotation_first(words: list[str]) -> list[str]:
    """Matrices with the rotation first, of diagonal ones in space."""
    triangle = words[10:]
    places = [0, 6, 11, 15, 18, 20]  # of the diagonal
    swapped = list(triangle)
    for k, place in enumerate(places):
        swapped[place] = triangle[places[(k + 3) % 6]]
    return [*words[:10], *swapped]


def without_path(text: str, path: Path) -> str:
    """A message without the path of the file, on one line that fits a table."""
    on_one_line = text.replace(str(path), "").replace("\n", "; ").lstrip(": ")
    return on_one_line.replace("|", "/")[:SHOWN]


def row(name: str, read: Callable[[], pgo.PoseGraph], seconds: float, path: Path | None) -> str:
    """Row of the table for one graph; the readings are compared of the file at `path`."""
    shown_path = path or Path(name)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            graph = read()
            began = time.process_time()
            solution = solvers.solve(graph, time_limit=seconds, progress=False)
        except PGOError as error:
            reason = without_path(str(error), shown_path)
            return f"| {name} | - | - | - | - | - | refused | - | {reason} |"
    spent = time.process_time() - began
    texts = (without_path(str(warning.message), shown_path) for warning in caught)
    notes = list(dict.fromkeys(texts))
    if path is not None:
        with warnings.catch_warnings(action="ignore"):
            notes += [f"read {fit.text}?" for fit in compare_readings(path).proposed]
    certificate = solution.certificate
    cells = [
        name,
        len(graph.bodies),
        len(graph.landmarks),
        graph.num_edges,
        f"{solution.problem.cost_name} {rounded_up(certificate.objective_at_most, 7)}",
        rounded_up(certificate.proven_gap, 2),
        solution.verdict.name,
        f"{spent:.2f}",
        "; ".join(notes) or "-",
    ]
    return f"| {' | '.join(map(str, cells))} |"


def show(paths: list[Path], seconds: float, with_readings: bool) -> None:
    print(HEAD)
    for path in sorted(paths, key=lambda path: path.name.lower()):
        compared = path if with_readings else None
        print(row(path.name, partial(pgo.load, path), seconds, compared), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="pose graphs as people have them, and GTSAM's")
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--gtsam", action="store_true")
    parser.add_argument("--seconds", type=float, default=60.0)
    arguments = parser.parse_args()
    if arguments.files or arguments.gtsam:
        gtsam = folder_of_gtsam().iterdir() if arguments.gtsam else []
        files = [*arguments.files, *(path for path in gtsam if path.is_file())]
        show(files, arguments.seconds, with_readings=False)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        paths = []
        for form, lines in forms(folder):
            path = folder / (form if "." in form else f"{form}.g2o")
            path.write_text("\n".join(lines) + "\n")
            paths.append(path)
        packed = folder / "compressed.g2o.gz"
        packed.write_bytes(gzip.compress((folder / "plain_2d.g2o").read_bytes()))
        show([*paths, packed], arguments.seconds, with_readings=True)
    for name, read in factor_graphs():
        print(row(name, read, arguments.seconds, None), flush=True)


if __name__ == "__main__":
    main()
