"""Which reading of a file is meant: planted ones are named, and none of files as they should be."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import pgo_models as pgo
from pgo_models import NoiseModel, PoseGraph, Reading, write_g2o
from solvers import compare_readings

Change = Callable[[list[str]], list[str]]


def walk(d: int, std: float = 0.05) -> PoseGraph:
    """A robot on a lattice, whose errors are those that the information matrices say."""
    noise = NoiseModel(translation_std=std, rotation_std=0.4 * std)
    graph = pgo.grid_world(1, 60, np.random.default_rng(3), d=d, noise=noise)
    diagonal = np.diag([noise.tau] * d + [noise.tau / 0.16] * (2 * d - 3))
    information = np.tile(diagonal, (graph.num_edges, 1, 1))
    return dataclasses.replace(graph, information=information, truth=None, initial=None)


def scaled(first: int, last: int, factor: float) -> Change:
    def change(words: list[str]) -> list[str]:
        middle = [repr(factor * float(word)) for word in words[first:last]]
        return [*words[:first], *middle, *words[last:]]

    return change


def with_diagonal(power: float) -> Change:
    """Entries of the diagonal matrix to a power; zeros stay."""

    def change(words: list[str]) -> list[str]:
        first = 6 if words[0] == "EDGE_SE2" else 10
        values = [float(word) for word in words[first:]]
        return [*words[:first], *(repr(x**power if x else x) for x in values)]

    return change


def swapped(words: list[str]) -> list[str]:
    return [words[0], words[2], words[1], *words[3:]]


PLANTED: list[tuple[Reading, int, str, Change]] = [
    (Reading.CLOSURES_REVERSED, 2, "closures", swapped),
    (Reading.CLOSURES_REVERSED, 3, "closures", swapped),
    (Reading.ODOMETRY_REVERSED, 2, "odometry", swapped),
    (Reading.REVERSED, 3, "all", swapped),
    (Reading.W_FIRST, 3, "all", lambda words: [*words[:6], words[9], *words[6:9], *words[10:]]),
    (Reading.DEGREES, 2, "all", scaled(5, 6, 180.0 / np.pi)),
    (Reading.COVARIANCES, 2, "all", with_diagonal(-1.0)),
    (Reading.COVARIANCES, 3, "all", with_diagonal(-1.0)),
    (Reading.SQUARE_ROOTS, 3, "all", with_diagonal(0.5)),
    (Reading.CLOSURES_IN_MILLIMETRES, 2, "closures", scaled(3, 5, 1000.0)),
    (Reading.ODOMETRY_IN_MILLIMETRES, 3, "odometry", scaled(3, 6, 1000.0)),
]


def written(graph: PoseGraph, path: Path, which: str, change: Change) -> None:
    """Write a graph with some of its edges in another way."""
    write_g2o(graph, path)
    lines = []
    for line in path.read_text().splitlines():
        words = line.split()
        is_odometry = abs(int(words[1]) - int(words[2])) == 1
        is_chosen = which == "all" or is_odometry == (which == "odometry")
        lines.append(" ".join(change(words) if is_chosen else words))
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    ("reading", "d", "which", "change"), PLANTED, ids=lambda value: getattr(value, "name", None)
)
def test_a_planted_reading_is_named_and_the_corrected_file_is_right(
    reading: Reading, d: int, which: str, change: Change, tmp_path: Path, pgo_command
) -> None:
    # Square roots of information are told from it where errors are far below one.
    graph = walk(d, std=1e-4 if reading is Reading.SQUARE_ROOTS else 0.05)
    path = tmp_path / "walk.g2o"
    written(graph, path, which, change)
    comparison = compare_readings(path)
    assert [fit.reading for fit in comparison.proposed] == [reading], comparison.sentence()
    assert len(comparison.others) <= 14  # fifteen solves, those of pairs among them
    corrected = tmp_path / "corrected.g2o"
    code, _, err = pgo_command("info", path, "--reading", reading.value, "--out", corrected)
    assert code == 0, err
    again = pgo.read_g2o(corrected)
    cost = compare_readings(corrected).written.cost
    assert cost == pytest.approx(comparison.proposed[0].cost, rel=1e-6)
    np.testing.assert_allclose(again.kappa, graph.kappa, rtol=1e-9, atol=0)
    assert not compare_readings(corrected).proposed


def test_square_roots_of_matrices_that_are_not_large_are_mentioned(tmp_path: Path) -> None:
    """A file may as well claim a fiftieth of the information that it has: nothing is proposed."""
    written(walk(2, std=0.02), tmp_path / "walk.g2o", "all", with_diagonal(0.5))
    comparison = compare_readings(tmp_path / "walk.g2o")
    assert not comparison.proposed
    assert "or are square roots" in comparison.sentence()


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("std", [1e-4, 0.01, 0.2])
def test_no_other_reading_is_proposed_of_a_file_that_means_what_it_says(
    d: int, std: float, tmp_path: Path
) -> None:
    write_g2o(walk(d, std), tmp_path / "walk.g2o")
    comparison = compare_readings(tmp_path / "walk.g2o")
    assert 0.5 < comparison.written.times_expected < 2.0
    assert not comparison.proposed


def test_a_reading_that_is_better_beyond_chance_and_not_clearly_is_not_proposed(
    tmp_path: Path,
) -> None:
    """Closures are so short that their errors hide much of what it costs to reverse them."""
    graph = walk(2, std=0.7)
    path = tmp_path / "walk.g2o"
    written(graph, path, "closures", swapped)
    comparison = compare_readings(path)
    [fit] = [fit for fit in comparison.others if fit.reading is Reading.CLOSURES_REVERSED]
    assert fit.evidence > np.log(1e4)
    assert 1.5 * fit.cost < comparison.written.cost < 10.0 * fit.cost
    assert not comparison.proposed


@pytest.mark.parametrize("scale", [1e-8, 1e-4, 1e4])
def test_matrices_of_another_scale_are_no_other_reading(scale: float, tmp_path: Path) -> None:
    graph = walk(2)
    other = dataclasses.replace(graph, information=scale * graph.information)
    write_g2o(other, tmp_path / "walk.g2o")
    assert not [
        fit
        for fit in compare_readings(tmp_path / "walk.g2o").proposed
        if fit.reading not in (Reading.COVARIANCES, Reading.SQUARE_ROOTS)
    ]


def test_nothing_is_said_of_wrong_closures(tmp_path: Path) -> None:
    graph = walk(2)
    rng = np.random.default_rng(0)
    ends = np.sort(rng.choice(60, (12, 2), replace=False), axis=0)
    wrong = graph.with_edges(
        ends[:, 0],
        ends[:, 1],
        pgo.Poses(pgo.random_rotations(12, 2, rng), 3.0 * rng.standard_normal((12, 2))),
        kappa=2500.0,
        tau=400.0,
    )
    write_g2o(wrong, tmp_path / "wrong.g2o")
    comparison = compare_readings(tmp_path / "wrong.g2o")
    assert comparison.written.times_expected > 10
    assert not comparison.proposed


def test_nothing_is_said_where_every_edge_fits(tmp_path: Path) -> None:
    lines = [f"EDGE_SE2 {i} {(i + 1) % 4} 1 0 1.570796327 0.01 0 0 0.01 0 0.01" for i in range(4)]
    (tmp_path / "square.g2o").write_text("\n".join(lines))
    assert not compare_readings(tmp_path / "square.g2o").proposed


def test_lengths_that_are_made_smaller_are_no_better_reading(tmp_path: Path) -> None:
    # The robot stands still: in millimetres its odometry costs a millionth, and means no more.
    rng = np.random.default_rng(0)
    steps = [f"EDGE_SE2 {i} {i + 1} {rng.normal():.4f} {rng.normal():.4f} 0" for i in range(30)]
    closures = [f"EDGE_SE2 {i} {i + 5} 0 0 0" for i in range(20)]
    lines = [f"{line} 1 0 0 1 0 1" for line in steps + closures]
    (tmp_path / "still.g2o").write_text("\n".join(lines))
    comparison = compare_readings(tmp_path / "still.g2o")
    costs = {fit.reading: fit.cost for fit in comparison.others}
    assert costs[Reading.ODOMETRY_IN_MILLIMETRES] < 1e-5 * comparison.written.cost
    assert not comparison.proposed


def test_unit_weights_leave_out_readings_of_matrices(tmp_path: Path) -> None:
    path = tmp_path / "bare.g2o"
    written(walk(2), path, "closures", swapped)
    path.write_text("\n".join(" ".join(line.split()[:6]) for line in path.read_text().splitlines()))
    comparison = compare_readings(path, unit_weights=True)
    assert comparison.cost_name == "F"
    assert [fit.reading for fit in comparison.proposed] == [Reading.CLOSURES_REVERSED]
    assert Reading.COVARIANCES not in [fit.reading for fit in comparison.others]


SMALL = ("tinyGrid3D", "kitti_07", "MIT", "FR079")


@pytest.mark.parametrize("name", ["grid", "circle", "sphere", "robots"])
def test_no_other_reading_is_proposed_of_the_project_data(name: str) -> None:
    assert not compare_readings(name).proposed


@pytest.mark.parametrize("name", SMALL)
def test_no_other_reading_is_proposed_of_small_public_graphs(
    name: str, benchmark_data: Path
) -> None:
    assert not compare_readings(benchmark_data / f"{name}.g2o").proposed


@pytest.mark.slow
@pytest.mark.parametrize("part", range(6))  # of the graphs: side by side on several cores
@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")
def test_no_other_reading_is_proposed_of_any_public_graph(part: int, benchmark_data: Path) -> None:
    paths = sorted(
        path for path in benchmark_data.iterdir() if path.suffix == ".g2o" or path.is_dir()
    )
    assert len(paths) >= 12
    named = {path.name: compare_readings(path).proposed for path in paths[part::6]}
    assert not {name: proposed for name, proposed in named.items() if proposed}


def test_where_no_edge_checks_another_the_table_has_no_multiple(tmp_path):
    chain = [f"EDGE_SE2 {i} {i + 1} 1 0 0.1 100 0 0 100 0 400\n" for i in range(3)]
    (tmp_path / "chain.g2o").write_text("".join(chain))
    table = str(compare_readings(tmp_path / "chain.g2o"))
    assert {line.split()[-1] for line in table.splitlines()[1:]} == {"-"}
