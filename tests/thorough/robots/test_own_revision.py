"""Robots with own files reject what the whole graph would, in tens of rounds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from networks import Network, robots_with_files
from wrong_edges import spoiled

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel, PoseGraph, read_g2o
from pgo_models.graphs.g2o import write_g2o_folder


def world_in_files(
    folder: Path, seed: int, d: int, kind: str, share: float
) -> tuple[PoseGraph, np.ndarray]:
    """A spoiled grid world in the files of four robots, and which edges are wrong."""
    graph = pgo.grid_world(4, 60, np.random.default_rng(seed), d=d)
    graph, is_wrong = spoiled(graph, share, kind, seed)
    write_g2o_folder(graph, folder, graph.initial or pgo.Poses.identity(graph.num_poses, d))
    return graph, is_wrong


def edges_of(graph: PoseGraph) -> set[tuple[int, int, float]]:
    """Edges by their ends and what they measure."""
    ids = graph.pose_ids
    return {
        (int(i), int(j), round(float(t[0]), 6))
        for i, j, t in zip(ids[graph.i], ids[graph.j], graph.t_ij, strict=True)
    }


@pytest.mark.parametrize(
    ("seed", "d", "kind", "share"),
    [(0, 2, "random", 0.5), (1, 3, "random", 0.3), (1, 3, "aliased", 0.5), (3, 3, "aliased", 0.3)],
)
def test_they_keep_what_the_whole_graph_keeps(
    tmp_path: Path, seed: int, d: int, kind: str, share: float
) -> None:
    graph, _ = world_in_files(tmp_path / "in", seed, d, kind, share)
    central = solvers.solve(
        read_g2o(tmp_path / "in", trust_folder=True), robust=solvers.GNC(), progress=False
    )
    solution = solvers.solve_folder(
        tmp_path / "in", robust=solvers.GNC(), trust_folder=True, out=tmp_path / "out"
    )
    written = read_g2o(tmp_path / "out", trust_folder=True)
    kept = edges_of(central.problem.graph)
    assert edges_of(written) == kept
    assert solution.num_rejected == graph.num_edges - len(kept)
    assert solution.certificate.objective == pytest.approx(central.objective, rel=1e-6)
    assert solution.certificate.is_certified
    assert solution.ledger.rounds < 85  # 69 at most, with two solves and their proofs
    assert "which the map of the others contradicts" in " ".join(str(solution).split())


def test_right_edges_that_it_begins_without_come_back(tmp_path: Path) -> None:
    graph = pgo.grid_world(4, 60, np.random.default_rng(0), d=2)
    write_g2o_folder(graph, tmp_path, graph.truth)
    agreeing = solvers.solve_folder(tmp_path, robust=solvers.PCM(quantile=1 - 1e-9))
    solution = solvers.solve_folder(tmp_path, robust=solvers.GNC(quantile=1 - 1e-9))
    assert agreeing.num_rejected == solution.num_rejected == 0
    assert solution.certificate.objective == pytest.approx(agreeing.certificate.objective)


def test_a_solve_that_is_out_of_time_has_the_best_bound(tmp_path: Path) -> None:
    noise = NoiseModel(0.2, 0.2)
    rng = np.random.default_rng(1)
    write_g2o_folder(
        pgo.grid_world(3, 12, rng, noise=noise, loop_closure_probability=0.3), tmp_path
    )
    solution = solvers.solve_folder(tmp_path, robust=solvers.GNC(), time_limit=1e-6)
    assert solution.status is solvers.Status.TIME_LIMIT
    assert not solution.certificate.is_certified
    assert solution.certificate.lower_bound > 0.3 * solution.certificate.objective


def test_thresholds_follow_errors_that_are_smaller_than_the_matrices_claim(tmp_path: Path) -> None:
    """Of errors that are a tenth of it wrong closures agree with right ones, and all would stay."""
    graph = pgo.grid_world(4, 60, np.random.default_rng(0), d=3)
    loose = replace(graph, kappa=1e-2 * graph.kappa, tau=1e-2 * graph.tau, information=None)
    graph, is_wrong = spoiled(loose, 0.3, "random", 0)
    write_g2o_folder(graph, tmp_path / "in", pgo.Poses.identity(graph.num_poses, 3))
    solvers.solve_folder(
        tmp_path / "in", robust=solvers.GNC(), trust_folder=True, out=tmp_path / "out"
    )
    kept = edges_of(read_g2o(tmp_path / "out", trust_folder=True))
    assert kept == edges_of(graph.without_edges(is_wrong))


def test_a_team_that_keeps_its_measurements_does_the_same(tmp_path: Path) -> None:
    world_in_files(tmp_path, 0, 2, "random", 0.3)
    folder = solvers.solve_folder(tmp_path, robust=solvers.GNC(), trust_folder=True)
    robots = robots_with_files(
        tmp_path, 4, sharing=solvers.Sharing.INTERFACE, robust=solvers.GNC(), retry=0.3
    )
    network = Network(robots, np.random.default_rng(0), lost=0.1)
    network.run(300.0)
    for robot in robots.values():
        assert robot.solution is not None
        assert robot.solution.certificate.objective == pytest.approx(folder.certificate.objective)
        assert robot.is_certified == folder.is_certified
        assert robot.solution.robust == folder.robust
