"""The data files that GTSAM comes with: what loads, what is refused, and GTSAM's own loaders."""

import importlib.util
import warnings
from pathlib import Path

import numpy as np
import pytest
from graphs import random_poses

import pgo_models as pgo
from pgo_models import Chi2Convention, PoseGraph, Poses, Reading, chi2
from pgo_models.errors import FileFormatError

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("gtsam") is None, reason="GTSAM is an optional rival"
)

# File: poses, landmarks, edges, and words of the warning that says what was assumed.
LOADED = {
    "Klaus3.g2o": (3, 0, 3, ""),
    "cityTrees_reduced_1k.g2o": (1000, 66, 1405, "LANDMARK2"),
    "edge_se3_trackxyz_example.g2o": (1, 1, 1, ""),
    "edge_se3_trackxyz_missing_vertex.g2o": (1, 1, 1, "they are placed along edges"),
    "edge_se3_trackxyz_nonidentity_offset.g2o": (1, 1, 1, ""),
    "edge_se3_trackxyz_zero_range.g2o": (1, 1, 1, ""),
    "example.graph": (95, 24, 516, "BR"),
    "known_landmark_localization_20.g2o": (20, 4, 99, "100 is added to the ids of landmarks"),
    "known_landmark_localization_3.g2o": (3, 4, 14, "10 is added to the ids of landmarks"),
    "noisyToyGraph.txt": (4, 0, 5, ""),
    "optimizedNoisyToyGraph.txt": (4, 0, 5, ""),
    "orientationsNoisyToyGraph.txt": (4, 0, 5, ""),
    "pose2example.txt": (11, 0, 12, ""),
    "pose3Localizationexample.txt": (5, 0, 4, ""),
    "pose3example-grid.txt": (27, 0, 44, ""),
    "pose3example-offdiagonal-rewritten.txt": (2, 0, 1, ""),
    "pose3example-offdiagonal.txt": (2, 0, 1, ""),
    "pose3example.txt": (5, 0, 6, ""),
    "simpleGraph10gradIter.txt": (5, 0, 6, ""),
    "sphere2500.txt": (2500, 0, 4949, "EDGE3 matrices are taken as information"),
    "sphere2500_groundtruth.txt": (2500, 0, 4949, "EDGE3 matrices are taken as information"),
    "sphere_smallnoise.graph": (2200, 0, 8647, "8647 EDGE3 lines have no matrix"),
    "toyExample.g2o": (5, 0, 6, ""),
    "victoriaPark_reduced_1k.g2o": (1000, 48, 1605, "LANDMARK2"),
    "victoria_park.txt": (6969, 151, 10608, "ODOMETRY and LANDMARK matrices are taken as covarian"),
    "w100.graph": (100, 0, 300, "40 EQUIV lines are skipped"),
    "w10000.graph": (10000, 0, 64311, "5875 EQUIV lines are skipped"),
    "w100_30.g2o": (30, 0, 59, "iSAM's order"),
    "w20000.txt": (20061, 0, 26831, "iSAM's order"),
}
REFUSED = {
    "T1_city10000_04.txt": "several hypotheses",
    "example_with_vertices.g2o": "no edges",
    "goats_15.pyfg": "a factor graph of PyFG",
    "goats_16.pyfg": "a factor graph of PyFG",
}


def data() -> Path:
    spec = importlib.util.find_spec("gtsam")
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).parent / "Data"


def loaded(name: str) -> tuple[PoseGraph, str]:
    """The graph in a file, and the warnings of its reader."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        graph = pgo.load(data() / name)
    return graph, "\n".join(str(warning.message) for warning in caught)


@pytest.mark.parametrize("name", LOADED)
def test_pose_graphs_load_and_say_what_was_assumed(name: str) -> None:
    graph, said = loaded(name)
    *sizes, words = LOADED[name]
    assert [len(graph.bodies), len(graph.landmarks), graph.num_edges] == sizes
    assert words in said
    assert bool(words) == bool(said)
    assert graph.components()[0].size == graph.num_poses


def test_all_other_files_are_refused_in_one_line() -> None:
    names = {path.name for path in data().iterdir() if path.is_file()}
    for name in sorted(names - set(LOADED)):
        with (
            warnings.catch_warnings(action="ignore"),
            pytest.raises(FileFormatError) as caught,
        ):
            pgo.load(data() / name)
        text = str(caught.value)
        assert text.startswith(str(data() / name))
        assert "\n" not in text
        other = "bytes that are no text" if name.endswith(".mat") else "no line has a tag"
        assert REFUSED.get(name, other) in text


def values_of(poses: Poses):
    import gtsam

    values = gtsam.Values()
    for key in range(poses.num_poses):
        if poses.d == 2:
            theta = float(np.arctan2(poses.R[key, 1, 0], poses.R[key, 0, 0]))
            values.insert(key, gtsam.Pose2(*poses.t[key], theta))
        else:
            values.insert(key, gtsam.Pose3(gtsam.Rot3(poses.R[key]), poses.t[key]))
    return values


@pytest.mark.parametrize(
    "name", ["w100_30.g2o", "pose2example.txt", "Klaus3.g2o", "pose3example.txt", "toyExample.g2o"]
)
def test_costs_are_those_of_its_own_loader(name: str) -> None:
    import gtsam

    graph, _ = loaded(name)
    factors, _ = gtsam.readG2o(str(data() / name), graph.d == 3)
    assert factors.size() == graph.num_edges
    for seed in range(3):
        poses = random_poses(graph.num_poses, graph.d, seed)
        ours = chi2(graph, poses, Chi2Convention.GTSAM)
        np.testing.assert_allclose(2 * factors.error(values_of(poses)), ours, rtol=1e-9, atol=0)


def test_odometry_of_victoria_park_is_that_of_its_loader() -> None:
    import gtsam

    graph, _ = loaded("victoria_park.txt")
    factors, _ = gtsam.load2D(str(data() / "victoria_park.txt"))
    to_landmark = np.isin(graph.j, graph.landmarks)
    information = graph.information[np.flatnonzero(~to_landmark)]
    first = factors.at(0).noiseModel()
    np.testing.assert_allclose(information[0], first.information(), rtol=1e-9, atol=0)


AS_WRITTEN = Reading.AS_WRITTEN
ROUND_TRIPS = [
    ("full_3x3", AS_WRITTEN),
    ("comments", AS_WRITTEN),
    ("tutorial_tags", AS_WRITTEN),
    ("switchable", AS_WRITTEN),
    ("toro_order", AS_WRITTEN),
    ("kernel_and_data", AS_WRITTEN),
    ("closures_reversed", Reading.CLOSURES_REVERSED),
    ("degrees", Reading.DEGREES),
    ("covariances_for_information", Reading.COVARIANCES),
]


def assert_gtsam_reads_the_same(graph: PoseGraph, path: Path) -> None:
    import gtsam

    factors, _ = gtsam.readG2o(str(path), graph.d == 3)
    assert factors.size() == graph.num_edges
    for seed in range(3):
        poses = random_poses(graph.num_poses, graph.d, seed)
        ours = chi2(graph, poses, Chi2Convention.GTSAM)
        np.testing.assert_allclose(2 * factors.error(values_of(poses)), ours, rtol=1e-9, atol=0)


@pytest.mark.parametrize(("name", "reading"), ROUND_TRIPS)
@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")
def test_what_is_read_is_written_as_gtsam_reads_it(
    name: str, reading: Reading, pgo_command, tmp_path: Path
) -> None:
    case = Path(__file__).parents[2] / "cases" / f"{name}.g2o"
    plain = tmp_path / "plain.g2o"
    code, _, err = pgo_command("info", case, "--reading", reading.value, "--out", plain)
    assert code == 0, err
    assert_gtsam_reads_the_same(pgo.load(case, reading=reading), plain)


TRIANGLE = "9 1 0 0 2 0 8 0 1 0 0 7 0 0 1 30 1 2 40 3 50"
IN_SPACE = {
    "EDGE3": "EDGE3 {} 1 2 3 0.1 0.2 0.3 " + TRIANGLE,
    "EDGE_SE3": "EDGE_SE3 {} 1 2 3 0.1 0.2 0.3 0.9 " + TRIANGLE,
    "w first": "EDGE_SE3:QUAT {} 1 2 3 0.9 0.1 0.2 0.3 " + TRIANGLE,
    "switchable": "EDGE_SE3_SWITCHABLE {} 77 1 2 3 0.1 0.2 0.3 0.9 " + TRIANGLE,
    "no matrix": "EDGE_SE3:QUAT {} 1 2 3 0.1 0.2 0.3 0.9",
}


@pytest.mark.parametrize("kind", IN_SPACE)
@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")
def test_lines_in_space_are_written_as_gtsam_reads_them(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "space.g2o"
    path.write_text("\n".join(IN_SPACE[kind].format(ends) for ends in ("0 1", "1 2", "0 2")))
    reading = Reading.W_FIRST if kind == "w first" else AS_WRITTEN
    graph = pgo.read_g2o(path, reading=reading, unit_weights=kind == "no matrix")
    pgo.write_g2o(graph, tmp_path / "plain.g2o")
    assert_gtsam_reads_the_same(graph, tmp_path / "plain.g2o")
