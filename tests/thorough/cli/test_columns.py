"""What `pgo` prints for readers stays within 80 columns, and for programs it is JSON: every
command.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from wrong_edges import spoiled

from pgo_models import grid_world, read_g2o, write_g2o

Call = Callable[..., tuple[int, str, str]]
WIDTH = 80
FOR_READERS = [
    ("info",),
    ("info", "robots", "--split", "given"),
    ("solve", "sphere"),
    ("solve", "sphere", "--robots", "5", "--verbose"),
    ("solve", "robots", "--method", "consensus", "--cost", "chi2"),
    ("solve", "circle", "--method", "paper", "--max-iterations", "3"),
    ("certify", "sphere"),
    ("certify", "circle", "--cost", "chi2"),
    ("compare", "grid", "--robots", "2"),
    ("tables", "--only", "grid", "--seeds", "1"),
    ("generate", "random", "--out", "r.g2o"),
    ("verify", "--help"),
    *(
        (command, "--help")
        for command in ("solve", "certify", "info", "generate", "tables", "compare")
    ),
]
GRAPHS = (
    "intel",
    "MIT",
    "CSAIL",
    "FR079",
    "FRH",
    "manhattan",
    "M3500",
    "kitti_07",
    "parking-garage",
    "cubicle",
)


@pytest.fixture
def columns(pgo_command: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Call:
    """Runs `pgo` in an empty folder before a terminal of 80 columns."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    return pgo_command


def assert_narrow(out: str) -> None:
    # a path
    long = [
        line for line in out.splitlines() if len(line) > WIDTH and not line.startswith("written: /")
    ]
    assert out
    assert long == []


@pytest.mark.parametrize("arguments", FOR_READERS, ids=" ".join)
def test_what_is_printed_stays_within_80_columns(arguments: tuple[str, ...], columns: Call) -> None:
    for needed in ("matplotlib", "plotly"):
        pytest.importorskip(needed)
    code, out, _ = columns(*arguments)
    assert code in (0, 2, 3)
    assert_narrow(out)


@pytest.mark.parametrize("options", [(), ("--cost", "chi2"), ("--robots", "4")], ids=" ".join)
@pytest.mark.parametrize("name", GRAPHS)
def test_and_so_does_that_of_public_graphs(
    name: str, options: tuple[str, ...], columns: Call, benchmark_data: Path
) -> None:
    path = benchmark_data / f"{name}.g2o"
    if name == "cubicle" and "chi2" in options:
        options += ("--drop-coupling",)  # with indefinite matrices it has no chi2
        beginning = read_g2o(path).subgraph(np.arange(600))  # says as much of its open gap as all
        path = Path("cubicle.g2o")
        write_g2o(beginning, path)
    code, out, _ = columns("solve", path, *options)
    assert code in (0, 3)
    assert_narrow(out)


def test_and_that_of_robust_solves_which_name_edges(columns: Call, tmp_path: Path) -> None:
    write_g2o(
        spoiled(grid_world(1, 200, np.random.default_rng(0), d=2), 0.2, "random", 0)[0],
        tmp_path / "wrong.g2o",
    )
    for options in ((), ("--robust", "gnc"), ("--robust", "pcm-gnc")):
        code, out, _ = columns("solve", "wrong.g2o", *options)
        assert code in (0, 3)
        assert_narrow(out)
    assert "the rejected edges are wrong is not proven" in " ".join(out.split())


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (("info",), ("python", "numpy", "threads", "data sets")),
        (("info", "sphere", "--robots", "5"), ("graph", "poses", "F, estimate", "partition")),
        (("generate", "grid", "--out", "g.g2o"), ("graph", "poses", "written")),
        (("tables", "--only", "grid", "--seeds", "1"), ("rows", "notes")),
        (("compare", "grid", "--methods", "newton"), ("rows", "notes")),
        (("solve", "grid"), ("objective", "lower_bound")),
        (("certify", "grid"), ("objective", "lower_bound")),
    ],
    ids=str,
)
def test_json_is_all_there_is_and_quiet_is_nothing(
    arguments: tuple[str, ...], names: tuple[str, ...], columns: Call
) -> None:
    for needed in ("matplotlib", "plotly"):
        pytest.importorskip(needed)
    code, out, err = columns(*arguments, "--json")
    assert (code in (0, 3), err) == (True, "")
    assert set(names) <= json.loads(out).keys()
    if arguments[0] != "info":  # which does nothing but print
        assert columns(*arguments, "--quiet")[1:] == ("", "")


def test_numbers_of_a_graph_are_numbers_in_json(columns: Call) -> None:
    record = json.loads(columns("info", "sphere", "--robots", "5", "--json")[1])
    assert (record["poses"], record["edges"], record["partition"]["robots"]) == (50, 544, 5)
    assert record["F, estimate"] == pytest.approx(1942.6891)
    made = json.loads(columns("generate", "circle", "--out", "c.g2o", "--json")[1])
    assert [Path(path).name for path in made["written"]] == ["c.g2o", "c.truth.tum"]
    assert all(Path(path).exists() for path in made["written"])
