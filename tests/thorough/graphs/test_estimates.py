"""An estimate has one pose for every pose of the graph that it is of, and no others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, strategies as st

from pgo_models import PoseGraph, Poses, random_geometric, write_g2o
from pgo_models.errors import FileFormatError
from pgo_models.graphs.g2o import read_g2o_poses

Call = Callable[..., tuple[int, str, str]]


def numbered(seed: int, n: int, d: int) -> PoseGraph:
    """A graph with an estimate, and ids that leave gaps."""
    rng = np.random.default_rng(seed)
    graph = random_geometric(n, rng, d=d)
    ids = np.sort(rng.choice(10 * n, n, replace=False))
    return replace(graph, ids=ids, initial=graph.truth)


def assert_same_poses(a: Poses, b: Poses | None) -> None:
    assert b is not None
    np.testing.assert_allclose(a.stacked(), b.stacked(), rtol=0, atol=1e-13)


@given(st.integers(0, 2**32 - 1), st.integers(3, 12), st.sampled_from([2, 3]))
def test_an_estimate_has_every_pose_of_the_graph_and_no_other(seed: int, n: int, d: int) -> None:
    graph = numbered(seed, n, d)
    rng = np.random.default_rng(seed)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "estimate.g2o"
        write_g2o(graph, path)
        lines = [line for line in path.read_text().splitlines() if line.startswith("VERTEX")]
        tag, _, *numbers = lines[rng.integers(n)].split()
        newcomer = " ".join([tag, str(int(graph.pose_ids.max()) + 1), *numbers])
        chosen = int(rng.integers(n))
        others = {
            "is not in": [*lines, newcomer],
            f"no VERTEX line for pose {graph.pose_ids[chosen]} ": lines[:chosen]
            + lines[chosen + 1 :],
            r"is not in .* \(1 are not": [*lines[:chosen], newcomer, *lines[chosen + 1 :]],
            "second": [*lines, " ".join([*lines[chosen].split()[:2], "77", *numbers[1:]])],
        }
        for problem, wrong in others.items():
            path.write_text("\n".join(rng.permutation(wrong)))
            with pytest.raises(FileFormatError, match=problem) as raised:
                read_g2o_poses(path, graph)
            assert "\n" not in str(raised.value)
            assert str(path) in str(raised.value)
        path.write_text("\n".join(rng.permutation(lines)))
        assert_same_poses(read_g2o_poses(path, graph), graph.initial)


def test_a_landmark_is_no_pose_of_an_estimate(tmp_path: Path) -> None:
    graph = numbered(0, 6, 2)
    seen = graph.with_landmark(np.array([0, 1]), np.ones((2, 2)), 3.0)
    write_g2o(seen, tmp_path / "seen.g2o")
    assert_same_poses(read_g2o_poses(tmp_path / "seen.g2o", seen), seen.initial)
    text = (tmp_path / "seen.g2o").read_text()
    name = int(seen.pose_ids[seen.landmarks[0]])
    of_poses = [line for line in text.splitlines() if line.startswith("VERTEX")]
    point = next(line for line in of_poses if line.startswith("VERTEX_XY"))
    (tmp_path / "pose.g2o").write_text(
        "\n".join([*of_poses, ""]).replace(point, f"VERTEX_SE2 {name} 0 0 0")
    )
    with pytest.raises(
        FileFormatError, match=f"{name} is a pose here and a landmark of {seen.name}"
    ):
        read_g2o_poses(tmp_path / "pose.g2o", seen)
    (tmp_path / "few.g2o").write_text("\n".join(line for line in of_poses if line != point))
    with pytest.raises(FileFormatError, match=f"no VERTEX line for pose {name} "):
        read_g2o_poses(tmp_path / "few.g2o", seen)
    with pytest.raises(FileFormatError, match=f"pose {name} is not in {graph.name}"):
        read_g2o_poses(tmp_path / "seen.g2o", graph)


@pytest.mark.parametrize("suffix", ["g2o", "tum", "kitti"])
def test_poses_of_another_graph_are_no_estimate(
    suffix: str, pgo_command: Call, tmp_path: Path
) -> None:
    path = tmp_path / f"other.{suffix}"
    for other, graph in (("sphere", "grid"), ("grid", "sphere")):
        assert pgo_command("solve", other, "--out", path)[0] == 0
        code, out, err = pgo_command("certify", graph, "--estimate", path)
        assert (code, out, err.count("\n")) == (1, "", 1)
        assert f"{path}" in err
        assert "50" in err
        assert "27" in err
        assert "; give " in err


def test_an_estimate_of_more_poses_is_refused(pgo_command: Call, benchmark_data: Path) -> None:
    """MIT has 808 poses, intel 1,728, and the ids of the one are among those of the other."""
    other = benchmark_data / "intel.g2o"
    code, out, err = pgo_command("certify", benchmark_data / "MIT.g2o", "-e", other)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert f"{other}:809: pose 808 is not in MIT (920 are not; the file has 1728, MIT 808)" in err
