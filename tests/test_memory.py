"""Where memory is short, one line says so, from the first import on, and nothing crashes."""

import math
import resource
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from commands import ended, one_line, started
from processes import under_limit

import pgo_models as pgo
from pgo_models import errors
from pgo_models.errors import FileFormatError, MissingExtraError, PGOError, extra_module
from pgo_models.files import LONGEST_OF_ALL, read_blocks, read_text
from pgo_models.graphs.trajectories import read_kitti, read_times, read_tum
from pgo_models.memory import available_memory, check_memory, check_room
from solvers.cli import explanations, generate_command, options as cli_options
from solvers.reporting.graph_facts import memory_of_a_solve

pytestmark = pytest.mark.slow  # solves under limits of memory, each in a process of its own

MEGABYTE = 10**6


@pytest.fixture(scope="module")
def city(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("city") / "city.g2o"
    pgo.write_g2o(pgo.grid_world(1, 6000, np.random.default_rng(0), d=2), path)
    return path


def test_every_limit_ends_in_a_result_or_in_one_line(city):
    # From too little for the imports on; between, libraries would crash, or wait for ever, where
    # they get no memory.
    endings = []
    for megabytes in (150, 330, 460, 520, 3000):
        most = megabytes * MEGABYTE
        limited = {
            "preexec_fn": lambda most=most: resource.setrlimit(resource.RLIMIT_AS, (most, most))
        }
        code, out, err = ended(started("solve", city, "-q", **limited))
        assert code in (0, 1), (megabytes, err)
        assert (out, code == 0 or (one_line(err) and "memory" in err)) == ("", True), (
            megabytes,
            err,
        )
        endings.append(code)
    assert (endings[0], endings[-1]) == (1, 0)
    assert endings == sorted(endings, reverse=True)


def test_a_solve_beyond_what_is_available_is_refused_but_not_one_by_robots(
    pgo_command, monkeypatch
):
    monkeypatch.setattr("pgo_models.memory.available_memory", lambda: 1e4)
    code, out, err = pgo_command("solve", "sphere")
    assert (code, out, one_line(err)) == (1, "", True)
    assert "sphere: a solve takes about 0.513 MB of memory, and 0.01 MB is available" in err
    assert pgo_command("solve", "sphere", "--robots", "2", "-q") == (0, "", "")


def caught(act: Callable[..., object], *arguments: object) -> Exception | None:
    try:
        act(*arguments)
    except (MemoryError, PGOError) as error:
        return error
    return None


def test_memory_that_runs_out_in_an_import_is_no_missing_extra(monkeypatch):
    endings = [
        (ImportError("libopenblas.so: failed to map segment from shared object"), MemoryError),
        (ImportError("x.so: Cannot allocate memory"), MemoryError),
        (MemoryError(), MemoryError),
        (ModuleNotFoundError("No module named 'cvxopt'"), MissingExtraError),
    ]
    for raised, expected in endings:

        def fail(_: str, raised: Exception = raised) -> None:
            raise raised

        with monkeypatch.context() as patched:
            patched.setattr(errors.importlib, "import_module", fail)
            found = caught(extra_module, "cvxopt", "fast")
        assert isinstance(found, expected)


def test_an_import_without_memory_during_a_command_is_one_line(pgo_command, monkeypatch):
    def fails(*_: object, **__: object) -> None:
        raise ImportError("_rotation.so: failed to map segment from shared object")

    monkeypatch.setattr("solvers.cli.solve_command.solve", fails)
    code, out, err = pgo_command("solve", "grid")
    assert (code, out, err) == (
        1,
        "",
        f"pgo: grid takes more memory than there is; {explanations.MORE_MEMORY}\n",
    )


@pytest.mark.parametrize(
    "options",
    [
        ("random", "--poses", 10**9),
        ("random", "--poses", 10**9, "-d", 2),
        ("grid-world", "--poses", 10**5, "--robots", 10**4),
        ("victoria-park", "--poses", 10**6),
        ("random", "--poses", 10**30),
    ],
)
def test_a_scene_beyond_the_memory_is_refused_before_it_is_made(options, pgo_command, tmp_path):
    code, out, err = pgo_command("generate", *options, "-o", tmp_path / "x.g2o")
    assert (code, out, one_line(err)) == (1, "", True)
    assert "of memory, and " in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("scene", [cli_options.Scene.RANDOM, cli_options.Scene.GRID_WORLD])
@pytest.mark.parametrize("d", [2, 3])
def test_a_scene_takes_no_more_than_is_estimated_and_not_much_less(scene, d, tmp_path):
    def made() -> None:
        rng = np.random.default_rng(0)
        graph = generate_command.chosen_scene(
            scene, rng, 3000, 1 if scene.value == "grid-world" else None, d, None, None
        )
        pgo.write_g2o(graph, tmp_path / "x.g2o")

    made()  # what is imported late
    tracemalloc.start()
    made()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    estimate = generate_command.memory_of_scene(scene, 3000, d)
    assert estimate / 8 < peak < 2 * estimate


def test_what_is_available_is_bounded_by_the_limit_of_the_process():
    assert 0 < available_memory() < math.inf
    assert under_limit(64.0, available_memory) <= 64 * 2**20


def test_too_much_is_refused_with_both_sizes():
    check_memory(1.0, "a letter", "write less")
    with pytest.raises(
        PGOError, match=r"a library takes about 1e\+09 GB of memory, and .* is available; read less"
    ):
        check_memory(1e18, "a library", "read less")
    check_room(0)
    check_room(10**6)
    with pytest.raises(MemoryError, match="no room for"):
        check_room(2**62)


def test_the_estimate_of_a_solve_grows_with_the_graph():
    small, large = (pgo.random_geometric(n, np.random.default_rng(0), d=2) for n in (100, 200))
    assert 0 < memory_of_a_solve(small) < memory_of_a_solve(large)


READERS = pytest.mark.parametrize(
    "read", [pgo.read_g2o, read_tum, read_kitti, read_times], ids=lambda one: one.__name__
)


@READERS
def test_a_line_without_end_is_refused_before_it_is_held(read, tmp_path):
    for name, letter in (("zeros", b"\0"), ("letters", b"1")):
        path = tmp_path / name
        with path.open("wb") as file:
            file.write(b"# a file\n")
            file.write(letter)
            for _ in range(4 if letter == b"1" else 0):
                file.write(20_000_000 * letter)
            file.truncate(200_000_000)  # the rest are zeros
        tracemalloc.start()
        with pytest.raises(
            FileFormatError, match=rf"{name}:2: (bytes that are no text|a line of more than)"
        ):
            read(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 150e6


@pytest.mark.parametrize("end", [b"\n", b"\r", b"\r\n"], ids=["lf", "cr", "crlf"])
def test_lines_are_whole_wherever_blocks_end_and_errors_count_them(end, tmp_path):
    lines = [f"line {k} \u00e9".encode() for k in range(200)]
    path = tmp_path / "x"
    path.write_bytes(end.join(lines) + end)
    whole = "".join(line.decode() + "\n" for line in lines)
    for size in (*range(1, 40), 1000):
        blocks = list(read_blocks(path, size))
        assert "".join(blocks) == read_text(path, size) == whole
        assert all(block.endswith("\n") for block in blocks)
    for wrong in (b"\xff", b"\0", b"x" * (LONGEST_OF_ALL + 1)):
        path.write_bytes(end.join([*lines[:120], wrong, *lines]))
        for size in (13, 1000, 2**24):
            with pytest.raises(FileFormatError, match=r"x:121: "):
                read_text(path, size)
    path.write_bytes(end.join([b"#" * LONGEST_OF_ALL, b"1", b"2"]))
    np.testing.assert_array_equal(read_times(path), [1.0, 2.0])
