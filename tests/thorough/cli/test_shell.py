"""`pgo` in a shell, in a process of its own: Ctrl-C, closed pipes, pipes as files."""

import json
import os
import resource
import shlex
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from commands import ended, one_line, started

import pgo_models as pgo
from pgo_models import write_g2o
from pgo_models.graphs import scenes
from solvers.cli import app as cli
from solvers.cli.shell import command_to_type

ROOT = Path(cli.__file__).parents[2]
ENDLESS = [
    "solve",
    "sphere",
    "--method",
    "paper",
    "--tolerance",
    "1e-300",
    "--max-iterations",
    "100000000",
]


def test_ctrl_c_in_the_loop_leaves_the_best_iterate(tmp_path):
    process = started(*ENDLESS, "--verbose", "--out", tmp_path / "so_far.json")
    for _ in range(12):
        process.stdout.readline()  # the run is under way
    process.send_signal(signal.SIGINT)
    ending, out, err = ended(process)
    assert (ending, err) == (2, "")
    assert "INTERRUPTED" in out
    assert json.loads((tmp_path / "so_far.json").read_text())["status"] == "INTERRUPTED"


def test_ctrl_c_before_the_loop_is_one_line(tmp_path):
    os.mkfifo(tmp_path / "graph")
    process = started("solve", tmp_path / "graph", "--out", tmp_path / "x.tum")
    with open(tmp_path / "graph", "w") as graph:  # opens when the command reads
        graph.write("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
        graph.flush()
        time.sleep(0.2)  # now it waits for more
        process.send_signal(signal.SIGINT)
        ending, out, err = ended(process)
    assert (ending, out, one_line(err)) == (130, "", True), err
    assert "before it was done" in err
    assert os.listdir(tmp_path) == ["graph"]


def test_a_pipe_that_closes_gives_no_traceback_and_the_file_is_written(tmp_path):
    reading, writing = os.pipe()
    os.close(reading)
    process = started("solve", "grid", "--out", tmp_path / "x.tum", stdout=writing)
    os.close(writing)
    ending, _, err = ended(process)
    assert (ending, err) == (1, "")
    assert len((tmp_path / "x.tum").read_text().splitlines()) == 27


def test_one_file_that_cannot_be_written_does_not_keep_the_others(tmp_path):
    # No check before the solve can see it: the g2o file outgrows what the process may write, the
    # trajectory does not.
    limited = {"preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (8_000, 8_000))}
    outs = (word for name in ("x.g2o", "x.tum") for word in ("-o", tmp_path / name))
    ending, out, err = ended(started("solve", "grid", *outs, **limited))
    assert (ending, err) == (
        1,
        f"pgo: cannot write {tmp_path}/x.g2o: File too large; choose a place that can be written\n",
    )
    assert f"written: {tmp_path}/x.tum" in out
    assert os.listdir(tmp_path) == ["x.tum"]


@pytest.mark.parametrize("name", ["/dev/stdin", "fifo"])
def test_a_graph_may_come_through_a_pipe(tmp_path, name):
    text = Path(ROOT / "data" / "grid.g2o").read_text()
    if name == "/dev/stdin":
        process = started("info", name, stdin=subprocess.PIPE)
        out, err = process.communicate(text, timeout=60)
    else:
        os.mkfifo(tmp_path / name)
        process = started("info", tmp_path / name)
        writer = threading.Thread(target=(tmp_path / name).write_text, args=(text,))
        writer.start()
        _, out, err = ended(process)
        writer.join()
    assert (process.returncode, err) == (0, "")
    assert f"{Path(name).name}, 3D" in out
    assert "108" in out


@pytest.mark.filterwarnings("default::pgo_models.errors.GraphWarning")
def test_weights_that_cannot_be_factored_are_named_with_line_and_edge(tmp_path, pgo_command):
    weights = [1e30 if k == 77 else 1 for k in range(199)]
    lines = [f"EDGE_SE2 {k} {k + 1} 1 0 0 {w} 0 0 {w} 0 {w}\n" for k, w in enumerate(weights)]
    lines += [f"EDGE_SE2 {k} {k + 20} 20 0 0.01 1 0 0 1 0 1\n" for k in range(0, 180, 7)]
    (tmp_path / "weights.g2o").write_text("".join(lines))
    ending, out, err = pgo_command("solve", tmp_path / "weights.g2o", "--cost", "isotropic")
    assert (ending, one_line(err)) == (3, True), err
    assert "verdict      TRIVIAL" in out
    assert "weights.g2o:78: kappa of edge 77 -> 78 is 1e+30, 1e+30 times the median" in err
    assert "correct the information matrix" in err


@pytest.mark.filterwarnings("default::pgo_models.errors.GraphWarning")
def test_a_weight_that_hides_the_others_is_named_where_there_is_no_proof(tmp_path, pgo_command):
    lines = (Path(__file__).parents[3] / "data" / "grid.g2o").read_text().splitlines()
    edge = next(k for k, line in enumerate(lines) if line.startswith("EDGE"))
    fields = lines[edge].split()
    path = tmp_path / "heavy.g2o"
    for ratio, ending in ((1e9, 0), (1e15, 3)):
        heavy = [*fields[:10], *(repr(ratio * float(value)) for value in fields[10:])]
        path.write_text("\n".join([*lines[:edge], " ".join(heavy), *lines[edge + 1 :]]) + "\n")
        code, out, err = pgo_command("solve", path)
        assert code == ending, err
        if ratio > 1e9:
            assert "TRIVIAL" in out
            assert one_line(err), err
            ends = f"{fields[1]} -> {fields[2]}"
            assert f"heavy.g2o:{edge + 1}: kappa of edge {ends} is 5.24e+14, 1e+15 times" in err
            assert "--cost unit" in err
        else:
            assert ("CERTIFIED" in out, err) == (True, "")


@pytest.mark.filterwarnings("default::pgo_models.errors.GraphWarning")
def test_a_light_weight_that_alone_joins_poses_is_named_and_a_heavy_one_beside_noise_is_not(
    tmp_path, pgo_command
):
    lines = (Path(__file__).parents[3] / "data" / "grid.g2o").read_text().splitlines()
    edges = [line.split() for line in lines if line.startswith("EDGE")]
    again = [
        " ".join([edge[0], *(str(int(pose) + 27) for pose in edge[1:3]), *edge[3:]])
        for edge in edges
    ]
    bridge = " ".join(
        [edges[0][0], "0", "27", *edges[0][3:10], *(repr(1e-12 * float(x)) for x in edges[0][10:])]
    )
    (tmp_path / "light.g2o").write_text(
        "\n".join([*(" ".join(edge) for edge in edges), *again, bridge]) + "\n"
    )
    code, _, err = pgo_command("solve", tmp_path / "light.g2o")
    assert (code, one_line(err)) == (3, True), err
    assert (
        f"light.g2o:{2 * len(edges) + 1}: kappa of edge 0 -> 27 is 5.24e-13, 1e-12 times the median"
        in err
    )
    noisy = scenes.random_geometric(40, np.random.default_rng(0), noise=scenes.NoiseModel(0.5, 1.0))
    factor = np.where(np.arange(noisy.num_edges) == 3, 2e10, 1.0)
    write_g2o(noisy.with_weights(factor * noisy.kappa, factor * noisy.tau), tmp_path / "noisy.g2o")
    code, out, err = pgo_command("solve", tmp_path / "noisy.g2o")
    assert (code, "NOT_CERTIFIED" in out, err) == (3, True, "")


def test_the_same_graph_is_read_whatever_ends_its_lines(tmp_path):
    graph = scenes.grid(np.random.default_rng(0))
    write_g2o(graph, tmp_path / "lf.g2o")
    data = (tmp_path / "lf.g2o").read_bytes()
    for name, end in (("cr", b"\r"), ("crlf", b"\r\n")):
        (tmp_path / f"{name}.g2o").write_bytes(data.replace(b"\n", end))
        np.testing.assert_array_equal(pgo.read_g2o(tmp_path / f"{name}.g2o").t_ij, graph.t_ij)


def test_the_shell_completes_commands_and_options():
    expected = {
        "pgo so": "solve",
        "pgo solve --rob": "--robust",
        "pgo solve grid --split m": "metis",
    }
    for words, completed in expected.items():
        env = {
            "_PGO_COMPLETE": "complete_bash",
            "COMP_WORDS": words,
            "COMP_CWORD": str(words.count(" ")),
        }
        program = "import sys; sys.argv[0] = 'pgo'; from solvers.cli.app import main; main()"
        run = [sys.executable, "-c", program]
        done = subprocess.run(
            run, env={**os.environ, **env}, capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert completed in done.stdout.split()


def test_a_name_that_the_terminal_has_no_letters_for_is_shown_all_the_same(tmp_path, monkeypatch):
    path = tmp_path / "\u0433\u0440\u0430\u0444.g2o"
    path.write_text(Path(ROOT / "data" / "grid.g2o").read_text())
    monkeypatch.setenv("PYTHONIOENCODING", "latin-1")
    code, out, err = ended(started("info", path))
    assert (code, err) == (0, "")
    assert r"\u0433" in out


@pytest.mark.parametrize("columns", [20, 40, 80, 200])
def test_a_command_is_broken_into_lines_that_a_shell_reads_as_one(columns, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    words = [
        "pgo",
        "solve",
        "a folder/it's here.g2o",
        "--cost",
        "chi2",
        "--drop-edge",
        "here.g2o:22475",
    ]
    text = command_to_type(shlex.join(words))
    assert shlex.split(text.replace("\\\n", " ")) == words
    for line in text.split("\n"):
        assert len(line) <= columns or len(shlex.split(line.removesuffix(" \\"))) == 1
    assert columns < 200 or text == f"    {shlex.join(words)}"
