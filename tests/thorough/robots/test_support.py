"""What supports edges that robots with own files keep: at most what supports them in one place."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from wrong_edges import joined_by, noisy_sphere, spoiled

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel, PoseGraph, read_g2o
from pgo_models.graphs.g2o import write_g2o_folder
from solvers import Solution
from solvers.robots_solution import RobotsSolution
from solvers.robust.known import odometry

Robust = solvers.GNC | solvers.PCM


def both(graph: PoseGraph, folder: Path, robust: Robust) -> tuple[RobotsSolution, Solution]:
    """By robots with own files, and in one place."""
    write_g2o_folder(graph, folder, graph.initial or graph.truth)
    robots = solvers.solve_folder(folder, robust=robust, trust_folder=True)
    whole = read_g2o(folder, trust_folder=True)
    return robots, solvers.solve(whole, robust=robust, progress=False)


@pytest.mark.parametrize(
    ("robust", "d", "share"),
    [(solvers.GNC(), 2, 0.2), (solvers.GNC(), 3, 0.0), (solvers.PCM(), 3, 0.4)],
    ids=lambda value: type(value).__name__ if isinstance(value, Robust) else f"{value}",
)
def test_they_earn_what_one_place_earns(
    robust: Robust, d: int, share: float, tmp_path: Path
) -> None:
    graph = pgo.grid_world(3, 60, 1, d=d)
    if share:
        graph, _ = spoiled(graph, share, "random", 1)
    robots, whole = both(graph, tmp_path / "in", robust)
    assert whole.robust is not None
    assert robots.is_certified == whole.is_certified
    assert robots.is_certified
    assert f"{whole.robust.held}, and nothing speaks against them" in robots.robust


@pytest.mark.parametrize("seed", range(examples(3)))
@pytest.mark.parametrize("kind", ["random", "aliased"])
def test_nothing_is_certified_that_one_place_doubts(kind: str, seed: int, tmp_path: Path) -> None:
    """Neither in the plane, where many wrong closures fit by chance, nor where runs agree."""
    rng = np.random.default_rng(seed)
    graph = pgo.grid_world(3, int(rng.integers(20, 50)), rng, d=2)
    graph, is_wrong = spoiled(graph, rng.uniform(0.2, 0.8), kind, seed)
    robots, whole = both(graph, tmp_path / "in", solvers.GNC())
    assert whole.is_certified or not robots.is_certified
    if robots.is_certified:
        kept = read_g2o(tmp_path / "in", trust_folder=True).num_edges - robots.num_rejected
        assert kept == (~is_wrong).sum()


def test_the_only_edge_between_two_pieces_of_one_robot_is_doubted(tmp_path: Path) -> None:
    """As between two robots: where its odometry has a gap, and one closure joins both sides."""
    graph = noisy_sphere(120, 20, NoiseModel(0.02, 0.02), 0)
    graph = graph.with_robots(np.arange(120) // 60)
    gap = (np.minimum(graph.i, graph.j) < 90) & (np.maximum(graph.i, graph.j) >= 90)
    others = np.flatnonzero(gap & ~odometry(graph))
    left_out = gap.copy()
    left_out[others[0]] = False
    robots, whole = both(graph.without_edges(left_out), tmp_path / "in", solvers.PCM())
    assert not whole.is_certified
    assert not robots.is_certified
    assert robots.num_bridges == 1
    robots, whole = both(joined_by(1), tmp_path / "two", solvers.PCM())
    assert robots.num_bridges == 1
    assert robots.is_certified == whole.is_certified is False


def test_edges_that_do_not_fit_together_and_steps_that_slip_are_doubted(tmp_path: Path) -> None:
    graph = replace(pgo.grid_world(3, 60, 1, d=3), information=None)
    strict = replace(graph, kappa=1.8 * graph.kappa, tau=1.8 * graph.tau)
    robots, whole = both(strict, tmp_path / "strict", solvers.PCM(quantile=0.99999))
    assert whole.robust is not None
    assert "the edges kept do not fit together" in whole.robust.doubts
    assert "the edges kept do not fit together" in robots.robust
    assert not robots.is_certified
    t_ij = graph.t_ij.copy()
    slip = int(np.flatnonzero(odometry(graph) & (graph.i == 30))[0])
    t_ij[slip] += 3.0
    slipped = replace(graph, t_ij=t_ij)
    robots, _ = both(slipped, tmp_path / "slipped", solvers.GNC(known=solvers.Known.ODOMETRY))
    assert not robots.is_certified
