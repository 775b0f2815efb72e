import dataclasses
import hashlib
import http.server
import re
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import pgo_models
from pgo_models import PGOError, PoseGraph, circle, load, read_g2o, write_tum
from pgo_models.errors import DatasetError, FileFormatError
from pgo_models.graphs import datasets
from pgo_models.graphs.datasets import CHECKSUMS, DATA_VARIABLE, known_datasets

DATA = Path(pgo_models.__file__).parent.parent / "data"
GRAPH = b"EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
ROUNDING = 1e-12  # the standard functions of two machines may differ in the last bits


class QuietHandler(http.server.SimpleHTTPRequestHandler):
    """Serves a folder and writes no log."""

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Path, str]]:
    """Served folder and its address."""
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    folder = tmp_path / "served"
    folder.mkdir()
    handler = partial(QuietHandler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as httpd:
        thread = threading.Thread(target=httpd.serve_forever, args=(0.01,))
        thread.start()
        yield folder, f"http://127.0.0.1:{httpd.server_port}"
        httpd.shutdown()
        thread.join()


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No data folder but the project's."""
    monkeypatch.delenv(DATA_VARIABLE, raising=False)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder that stands for the user's cache."""
    folder = tmp_path / "cache" / "deeper"
    monkeypatch.setattr("pooch.os_cache", lambda name: folder)
    return folder


@pytest.fixture
def offered(
    server: tuple[Path, str], cache: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], Path]:
    """Offer a data set "far" with a checksum by the server, and return its file there."""
    folder, url = server

    def offer(checksum: str) -> Path:
        monkeypatch.setattr(datasets, "SE_SYNC_URL", url)
        monkeypatch.setattr(datasets, "CHECKSUMS", {"far": checksum})
        return folder / "far.g2o"

    return offer


def sha256(data: bytes) -> str:
    return "sha256:" + hashlib.sha256(data).hexdigest()


def blob(data: bytes) -> str:
    return "blob:" + hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()


def assert_regenerated(committed: PoseGraph, graph: PoseGraph) -> None:
    np.testing.assert_array_equal(committed.i, graph.i)
    np.testing.assert_array_equal(committed.j, graph.j)
    for name in ("R_ij", "t_ij", "kappa", "tau"):
        np.testing.assert_allclose(
            getattr(committed, name), getattr(graph, name), rtol=ROUNDING, atol=ROUNDING
        )
    for name in ("initial", "truth"):
        np.testing.assert_allclose(
            getattr(committed, name).t, getattr(graph, name).t, rtol=0, atol=ROUNDING
        )
        np.testing.assert_allclose(
            getattr(committed, name).R, getattr(graph, name).R, rtol=0, atol=ROUNDING
        )


def test_the_readme_regenerates_the_data_folder(tmp_path: Path) -> None:
    code = re.search(r"```python\n(.*?)```", (DATA / "README.md").read_text(), re.DOTALL)
    assert code is not None
    (tmp_path / "data").mkdir()
    exec(compile(code[1], "data/README.md", "exec"), {})
    made = sorted(
        file.relative_to(tmp_path / "data")
        for file in (tmp_path / "data").rglob("*")
        if file.is_file()
    )
    kept = {file.relative_to(DATA) for file in DATA.rglob("*") if file.is_file()}
    assert kept - set(made) == {Path("README.md"), Path("reference.json")}
    for name in ("circle", "grid", "sphere", "robots"):
        again = tmp_path / "data" / ("robots" if name == "robots" else f"{name}.g2o")
        assert_regenerated(load(name), load(again))
        np.testing.assert_array_equal(load(name).pose_ids, load(again).pose_ids)


def test_the_robots_example_has_owners_and_truth() -> None:
    graph = load("robots")
    assert (graph.num_robots, graph.num_poses, graph.d) == (4, 160, 3)
    assert graph.truth is not None
    assert graph.initial is not None
    assert graph.is_connected
    between = graph.robots[graph.i] != graph.robots[graph.j]
    assert between.any()
    lines = sum(
        text.count("EDGE")
        for text in ((DATA / "robots" / f"{r}.g2o").read_text() for r in range(4))
    )
    assert lines == graph.num_edges + between.sum()


def test_paths_are_read(tmp_path: Path) -> None:
    (tmp_path / "own.g2o").write_bytes(GRAPH)
    for path in (tmp_path / "own.g2o", str(tmp_path / "own.g2o"), "own.g2o"):
        assert load(path).num_edges == 1
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "0.g2o").write_bytes(GRAPH)
    assert load("folder").num_edges == 1
    (tmp_path / "circle").mkdir()
    assert load("circle").num_poses == 25  # a folder of that name which holds no graph is not meant
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileFormatError, match="without g2o files"):
        load("empty")
    for path in ("missing.g2o", "./missing", tmp_path / "circle2"):
        with pytest.raises(FileFormatError, match="no such file or folder"):
            load(path)


def test_truth_beside_a_graph_is_found_and_checked(tmp_path: Path) -> None:
    (tmp_path / "own.g2o").write_bytes(GRAPH)
    truth = dataclasses.replace(circle(np.random.default_rng(0)).subgraph(np.array([0, 1]))).truth
    assert truth is not None
    write_tum(truth, tmp_path / "own.truth.tum")
    with pytest.raises(FileFormatError, match=r"own.truth.tum:2: pose is out of the x-y plane"):
        load("own.g2o")
    (tmp_path / "own.truth.tum").write_text("0 0 0 0 0 0 0 1\n")
    with pytest.raises(FileFormatError, match=r"1 poses, but own\.g2o has 2"):
        load("own.g2o")
    (tmp_path / "own.truth.tum").write_text("0 0 0 0 0 0 0 1\n1 5 6 0 0 0 0 1\n")
    found = load("own.g2o").truth
    assert found is not None
    np.testing.assert_array_equal(found.t, [[0, 0], [5, 6]])


def test_names_are_found_in_the_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("data", "mine"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / f"{folder}_data.g2o").write_bytes(GRAPH)
    assert load("data_data").name == "data_data"
    with pytest.raises(DatasetError, match="'mine_data'"):
        load("mine_data")
    monkeypatch.setenv(DATA_VARIABLE, str(tmp_path / "mine"))
    assert load("mine_data").name == "mine_data"
    assert {"data_data", "mine_data", "circle", "robots", "torus3D"} <= set(known_datasets())


def test_unknown_names_list_the_known(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DatasetError) as caught:
        load("shpere")
    message = str(caught.value)
    assert "did you mean sphere" in message
    assert all(name in message for name in known_datasets())
    assert DATA_VARIABLE in message
    monkeypatch.setenv(DATA_VARIABLE, "no-such-folder")
    with pytest.raises(DatasetError, match="'nothing'; known are"):
        load("nothing")


def test_without_download_only_what_is_here_is_taken(
    offered: Callable[[str], Path], cache: Path
) -> None:
    offered(sha256(GRAPH)).write_bytes(GRAPH)
    with pytest.raises(
        DatasetError,
        match=rf"far is not here; download it with: pgo info far, or .*{DATA_VARIABLE}",
    ):
        load("far", download=False)
    assert not cache.exists()
    load("far")
    assert load("far", download=False).num_edges == 1


@pytest.mark.parametrize("checksum", [sha256, blob])
def test_downloads_are_checked_and_kept(
    offered: Callable[[str], Path],
    cache: Path,
    checksum: Callable[[bytes], str],
    capfd: pytest.CaptureFixture[str],
) -> None:
    far = offered(checksum(GRAPH))
    far.write_bytes(GRAPH)
    assert load("far").num_edges == 1
    far.unlink()
    assert load("far").name == "far"
    # A file in the cache that has changed is not used.
    (cache / "far.g2o").write_bytes(GRAPH * 2)
    with pytest.raises(DatasetError, match="status 404"):
        load("far")
    far.write_bytes(GRAPH)
    assert load("far").num_edges == 1
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("checksum", [sha256, blob])
def test_a_corrupt_download_is_not_kept(
    offered: Callable[[str], Path], cache: Path, checksum: Callable[[bytes], str]
) -> None:
    offered(checksum(GRAPH[:-1])).write_bytes(GRAPH)
    with pytest.raises(DatasetError, match="does not have the checksum"):
        load("far")
    assert not list(cache.iterdir())


@pytest.mark.parametrize(
    ("url", "reason"), [(None, "status 404"), ("http://127.0.0.1:9", "no connection")]
)
def test_offline_says_what_is_missing_and_how_to_get_it(
    offered: Callable[[str], Path],
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    url: str | None,
    reason: str,
) -> None:
    offered(sha256(GRAPH))
    monkeypatch.setenv("no_proxy", "*")
    if url is not None:
        monkeypatch.setattr(datasets, "SE_SYNC_URL", url)
    with pytest.raises(DatasetError) as caught:
        load("far")
    message = str(caught.value)
    assert reason in message
    assert "far.g2o" in message
    assert DATA_VARIABLE in message
    assert "\n" not in message
    assert not list(cache.iterdir())


def test_a_cache_that_cannot_be_made_is_named(offered: Callable[[str], Path], cache: Path) -> None:
    offered(sha256(GRAPH))
    cache.parent.write_text("")
    with pytest.raises(PGOError, match="cannot make the cache folder"):
        load("far")


def test_benchmarks_have_the_checksums_of_the_registry(benchmark_data: Path) -> None:
    for name, checksum in CHECKSUMS.items():
        path = benchmark_data / f"{name}.g2o"
        if checksum.startswith("sha256"):
            assert sha256(path.read_bytes()) == checksum
            assert read_g2o(path).name == name
