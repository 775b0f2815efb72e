"""JSON robot logs: a small one written by hand, and the same graph as from g2o."""

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, assert_says, informed
from hypothesis import example, given, strategies as st

import pgo_models as pgo
from pgo_models import PoseGraph, Reading, log_map, read_g2o, write_g2o
from pgo_models.errors import FileFormatError, GraphWarning, SettingError
from pgo_models.geometry.rotations import quaternions_from_rotations
from pgo_models.graphs.datasets import places_of_edges
from pgo_models.graphs.g2o import symbol_ids
from pgo_models.graphs.jrl import read_jrl

A0 = ord("a") << 56
B0 = ord("b") << 56
# GTSAM's order: the rotation of variance 0.01, the translation of variances 1, 4 and 9.
COVARIANCE = np.diag([0.01, 0.01, 0.01, 1.0, 4.0, 9.0]).ravel().tolist()
HALF = 0.5**0.5


def pose3(x: float, y: float, z: float, *wxyz: float) -> dict[str, Any]:
    rotation = list(wxyz) or [1.0, 0.0, 0.0, 0.0]
    return {"type": "Pose3", "translation": [x, y, z], "rotation": rotation}


def between(key1: int, key2: int, value: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "BetweenFactorPose3",
        "key1": key1,
        "key2": key2,
        "measurement": value,
        "covariance": COVARIANCE,
    }


PRIOR = {
    "type": "PriorFactorPose3",
    "key": A0,
    "prior": pose3(1, 2, 3),
    "covariance": COVARIANCE,
}
TURN = pose3(1, 0, 0, HALF, 0, 0, HALF)  # a quarter turn about z
MEETING = between(A0 + 1, B0, pose3(0, 5, 0))
# Two robots a and b; their meeting is in the logs of both.
LOG: dict[str, Any] = {
    "name": "meeting",
    "robots": [ord("a"), ord("b")],
    "measurements": {
        "b": [
            {"stamp": 1, "measurements": [between(B0, B0 + 1, TURN)]},
            {"stamp": 2, "measurements": [MEETING]},
        ],
        "a": [
            {"stamp": 0, "measurements": [PRIOR]},
            {"stamp": 1, "measurements": [between(A0, A0 + 1, TURN), MEETING]},
            {"stamp": 2},
        ],
    },
    "groundtruth": {
        "a": [{"key": A0, **pose3(1, 2, 3)}, {"key": A0 + 1, **TURN}],
        "b": [{"key": B0, **pose3(0, 0, 0)}, {"key": B0 + 1, **pose3(0, 0, 1)}],
    },
    "initialization": {"a": [{"key": A0, **pose3(1, 2, 3)}]},
    "potential_outlier_factors": {"a": [[2, 0]]},
}


def write(folder: Path, log: object) -> Path:
    path = folder / "log.jrl"
    path.write_text(json.dumps(log))
    return path


def test_a_log_of_two_robots_written_by_hand(tmp_path: Path) -> None:
    path = write(tmp_path, LOG)
    graph = read_jrl(path)
    assert repr(graph) == "PoseGraph('log', d=3, poses=4, edges=4, priors=1, robots=2)"
    np.testing.assert_array_equal(graph.pose_ids[:4], [A0, A0 + 1, B0, B0 + 1])
    np.testing.assert_array_equal(graph.robots[:4], [0, 0, 1, 1])
    np.testing.assert_array_equal(graph.i, [graph.world, 0, 1, 2])
    np.testing.assert_array_equal(graph.j, [0, 1, 2, 3])
    np.testing.assert_array_equal(graph.t_ij, [[1, 2, 3], [1, 0, 0], [0, 5, 0], [1, 0, 0]])
    np.testing.assert_allclose(
        graph.R_ij[1], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(
        graph.information[2], np.diag([1, 1 / 4, 1 / 9, 100, 100, 100]), rtol=1e-14, atol=0
    )
    np.testing.assert_allclose(graph.tau, 3 / (1 + 4 + 9), rtol=1e-14, atol=0)
    np.testing.assert_allclose(graph.kappa, 3 / (2 * 0.03), rtol=1e-14, atol=0)
    assert graph.initial is None  # one pose of four has a value
    assert graph.truth is not None
    np.testing.assert_array_equal(graph.truth.t, [[1, 2, 3], [1, 0, 0], [0, 0, 0], [0, 0, 1]])
    assert repr(pgo.load(path)) == repr(graph)
    # Measurements count from 1, robot by robot; the one in both logs is that of a.
    assert places_of_edges(path) == [f"{path}:{number}" for number in (1, 2, 3, 4)]


@given(seed=SEEDS, d=DIMENSIONS, num_robots=st.integers(1, 3))
def test_the_same_graph_as_from_g2o(
    tmp_path_factory: pytest.TempPathFactory, seed: int, d: int, num_robots: int
) -> None:
    folder = tmp_path_factory.mktemp("jrl")
    robots = np.arange(8) % num_robots
    graph = informed(seed, 8, d, coupled=True)
    graph = replace(graph, ids=symbol_ids(robots), robot=None, truth=None, name="log")
    write_g2o(graph, folder / "log.g2o")
    expected = read_g2o(folder / "log.g2o")
    logs: dict[str, list[Any]] = {chr(ord("a") + robot): [] for robot in range(num_robots)}
    for e in range(expected.num_edges):
        factor = factor_of(expected, e)
        logs[chr(ord("a") + robots_of(expected, e))].append({"stamp": e, "measurements": [factor]})
    path = write(folder, {"name": "log", "robots": list(logs), "measurements": logs})
    found = read_jrl(path)
    assert found.num_robots == num_robots
    np.testing.assert_array_equal(found.pose_ids, expected.pose_ids)
    order = np.argsort([robots_of(expected, e) for e in range(expected.num_edges)], kind="stable")
    np.testing.assert_array_equal(found.i, expected.i[order])
    np.testing.assert_array_equal(found.j, expected.j[order])
    np.testing.assert_array_equal(found.t_ij, expected.t_ij[order])
    np.testing.assert_allclose(found.R_ij, expected.R_ij[order], rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.kappa, expected.kappa[order], rtol=1e-9, atol=0)
    np.testing.assert_allclose(found.tau, expected.tau[order], rtol=1e-9, atol=0)
    size = np.abs(expected.information).max()
    np.testing.assert_allclose(
        found.information, expected.information[order], rtol=0, atol=1e-9 * size
    )


def robots_of(graph: PoseGraph, e: int) -> int:
    return int(graph.robots[graph.i[e]])


def factor_of(graph: PoseGraph, e: int) -> dict[str, Any]:
    covariance = np.linalg.inv(graph.information[e])
    covariance = 0.5 * (covariance + covariance.T)
    R = graph.R_ij[e]
    if graph.d == 2:
        x, y = graph.t_ij[e].tolist()
        value = {"type": "Pose2", "x": x, "y": y, "theta": float(log_map(R[None])[0, 0])}
    else:
        rotation_first = [3, 4, 5, 0, 1, 2]
        covariance = covariance[np.ix_(rotation_first, rotation_first)]
        *xyz, w = quaternions_from_rotations(R[None])[0].tolist()
        value = pose3(*graph.t_ij[e].tolist(), w, *xyz)
    return {
        "type": f"BetweenFactorPose{graph.d}",
        "key1": int(graph.pose_ids[graph.i[e]]),
        "key2": int(graph.pose_ids[graph.j[e]]),
        "measurement": value,
        "covariance": covariance.ravel().tolist(),
    }


def test_landmarks_by_bearing_and_range_belong_to_the_robot_that_logs_them(tmp_path: Path) -> None:
    landmark = (ord("l") << 56) + 3
    pose = {"type": "Pose2", "x": 1.0, "y": 0.0, "theta": 0.0}
    step = {"type": "BetweenFactorPose2", "measurement": pose, "covariance": np.eye(3).ravel()}
    step["covariance"] = np.eye(3).ravel().tolist()
    sight = {
        "type": "BearingRangeFactor2D",
        "key1": B0,
        "key2": landmark,
        "measurement": {"type": "BearingRange", "bearing": {"theta": np.pi / 2}, "range": 2.0},
        "covariance": [0.25, 0.0, 0.0, 4.0],
    }
    known = {
        "type": "PriorFactorPoint2",
        "key": landmark,
        "prior": {"type": "Point2", "x": 3.0, "y": 4.0},
        "covariance": [1.0, 0.0, 0.0, 1.0],
    }
    logs = {
        "a": [{"measurements": [{**step, "key1": A0, "key2": B0}]}],
        "b": [{"measurements": [{**step, "key1": B0, "key2": B0 + 1}, sight, known]}],
    }
    graph = read_jrl(write(tmp_path, {"measurements": logs}))
    np.testing.assert_array_equal(graph.landmarks, [3])
    np.testing.assert_array_equal(graph.robots[:4], [0, 1, 1, 1])  # B0 by its letter
    np.testing.assert_allclose(graph.t_ij[2], [0, 2], rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        graph.information[2][:2, :2], np.diag([1.0, 0.25]), rtol=0, atol=1e-15
    )
    assert graph.is_prior[3]


Change = Callable[[dict[str, Any]], object]


def measurement(log: dict[str, Any], robot: str, entry: int) -> dict[str, Any]:
    return log["measurements"][robot][entry]["measurements"][0]


@pytest.mark.parametrize(
    ("change", "where", "words"),
    [
        (lambda log: log.pop("measurements"), "", ["no robot log", "`measurements`"]),
        (lambda log: log["measurements"].update(a=3), "", ["robot a", "no list of objects"]),
        (lambda log: log.update(measurements={"a": []}), "", ["no measurement of the types"]),
        (
            lambda log: measurement(log, "a", 0).update(type="RangeFactorPose3"),
            ":1",
            ["'RangeFactorPose3' (1 of it)", "BetweenFactorPose3", "--skip-unknown"],
        ),
        (
            lambda log: measurement(log, "a", 1).update(key2=-1),
            ":2",
            ["BetweenFactorPose3: key2 is -1", "correct or remove"],
        ),
        (
            lambda log: measurement(log, "a", 1).update(key2=A0),
            ":2",
            [f"an edge from pose {A0} to itself"],
        ),
        (
            lambda log: measurement(log, "b", 0).update(covariance=[1.0]),
            ":4",
            ["covariance is [1.0], not 36 numbers"],
        ),
        (
            lambda log: measurement(log, "b", 0).update(covariance=[0.0] * 36),
            ":4",
            ["covariance matrix is not positive definite"],
        ),
        (
            lambda log: measurement(log, "b", 0).update(
                covariance=(1e-200 * np.eye(6)).ravel().tolist()
            ),
            ":4",
            ["information beyond 1e+100"],
        ),
        (
            lambda log: measurement(log, "b", 0).update(covariance=list(range(36))),
            ":4",
            ["covariance is not symmetric"],
        ),
        (
            lambda log: measurement(log, "b", 0).update(measurement=pose3(0, 0, 0, 0, 0, 0, 0)),
            ":4",
            ["zero quaternion"],
        ),
        (
            lambda log: measurement(log, "b", 0).update(measurement=pose3(0, 0, 1e200)),
            ":4",
            ["translation is 1e+200"],
        ),
        (
            lambda log: measurement(log, "b", 0).update(measurement=pose3(0, 0, float("nan"))),
            ":4",
            ["translation is nan"],
        ),
        (lambda log: log["initialization"].update(a=7), "", ["initialization of robot a"]),
        (
            lambda log: log["groundtruth"]["b"][1].update(rotation=[1, 0, 0]),
            "",
            ["groundtruth of robot b, value 2: rotation is [1, 0, 0], not 4 numbers"],
        ),
        (
            lambda log: log["groundtruth"]["b"][1].update(rotation=[0, 0, 0, 0]),
            "",
            ["groundtruth of robot b, pose or point 2: zero quaternion"],
        ),
    ],
)
def test_every_fault_has_its_measurement_and_a_way_out(
    tmp_path: Path, change: Change, where: str, words: list[str]
) -> None:
    log = copy.deepcopy(LOG)
    change(log)
    path = write(tmp_path, log)
    with pytest.raises(FileFormatError) as caught:
        read_jrl(path)
    assert_says(caught.value, f"{path}{where}: ", words)


def test_all_wrong_measurements_are_named_in_one_run(tmp_path: Path) -> None:
    log = copy.deepcopy(LOG)
    measurement(log, "a", 0).update(key="x")
    measurement(log, "b", 0).update(covariance=None)
    path = write(tmp_path, log)
    with pytest.raises(FileFormatError) as caught:
        read_jrl(path)
    first, second, last = str(caught.value).split("\n")
    assert first.startswith(f"{path}:1: PriorFactorPose3: key is 'x'")
    assert second.startswith(f"{path}:4: BetweenFactorPose3: covariance is None")
    assert last == "2 measurements are wrong"


def test_measurements_of_other_types_are_skipped_when_asked_for(tmp_path: Path) -> None:
    log = copy.deepcopy(LOG)
    log["measurements"]["a"].append({"measurements": [{"type": "CombinedImuFactor"}] * 2})
    path = write(tmp_path, log)
    with pytest.warns(GraphWarning, match=r"skipped: 2 of CombinedImuFactor \(first: 4\)"):
        graph = pgo.load(path, skip_unknown=True)
    assert graph.num_edges == 4


@pytest.mark.parametrize(
    ("data", "words"),
    [(b"{", "no JSON"), (b"\xa2\xff\xfe", "not as CBOR"), (b"[]", "no robot log")],
)
def test_files_that_are_no_logs_are_refused(tmp_path: Path, data: bytes, words: str) -> None:
    (tmp_path / "log.jrl").write_bytes(data)
    with pytest.raises(FileFormatError, match=words):
        read_jrl(tmp_path / "log.jrl")
    with pytest.raises(FileFormatError, match="no such file"):
        read_jrl(tmp_path / "missing.jrl")
    with pytest.raises(FileFormatError, match="no such file"):
        pgo.load("missing.jrl")


def test_square_roots_are_refused_of_a_log_which_has_covariances(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="says what it has, covariances; leave square-roots out"):
        pgo.load(write(tmp_path, LOG), reading=Reading.SQUARE_ROOTS)


def test_2d_and_3d_measurements_do_not_go_together(tmp_path: Path) -> None:
    log = copy.deepcopy(LOG)
    measurement(log, "b", 0).update(
        type="BetweenFactorPose2",
        measurement={"x": 1.0, "y": 2.0, "theta": 0.5},
        covariance=np.eye(3).ravel().tolist(),
    )
    with pytest.raises(FileFormatError, match=r":4: 2D and 3D in one file \(measurement 1 is"):
        read_jrl(write(tmp_path, log))


def places_in(part: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Keys and indices that lead to every part of a log."""
    keys: list[Any] = []
    if isinstance(part, dict):
        keys = list(part)
    elif isinstance(part, list):
        keys = list(range(len(part)))
    places = [(*place, key) for key in keys]
    for key in keys:
        places += places_in(part[key], (*place, key))
    return places


NUMBERS = st.sampled_from([0, -1, 1e99, 5e-324, 2**63 - 1, 2**64, 10**400, float("nan"), A0, B0])
TYPES = st.sampled_from(["x", "Pose2", "BearingRangeFactor2D", "BetweenFactorPose2", "Point3"])
WRONG_PARTS = NUMBERS | TYPES | st.sampled_from([None, True, [], {}, [1], [[]], {"theta": 1}])


@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")
@given(place=st.sampled_from(places_in(LOG)), wrong=WRONG_PARTS, skip_unknown=st.booleans())
@example(("measurements", "a", 1, "measurements", 0, "covariance", 7), 5e-324, False)
def test_a_damaged_log_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, place: tuple[Any, ...], wrong: Any, skip_unknown: bool
) -> None:
    log = copy.deepcopy(LOG)
    part: Any = log
    *path_to_part, last = place
    for key in path_to_part:
        part = part[key]
    part[last] = wrong
    path = write(tmp_path_factory.mktemp("jrl"), log)
    problem = str(path)
    try:
        read_jrl(path, skip_unknown=skip_unknown)
    except FileFormatError as error:
        problem = str(error)
    assert problem.startswith(str(path))
