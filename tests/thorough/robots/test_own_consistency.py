"""Closures between two robots with own files are judged by these two, as the whole graph would."""

from pathlib import Path

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS
from hypothesis import given, settings, strategies as st
from networks import Network, robots_with_files
from robots import Recording
from wrong_edges import joined_by, spoiled

import pgo_models as pgo
import solvers
from pgo_models import PoseGraph, read_g2o
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.g2o import write_g2o_folder
from solvers.robots.own_file import OwnGraph
from solvers.robust.consistency import pairwise_consistent


def world(seed: int, d: int, kind: str, folder: Path, num_robots: int = 3) -> PoseGraph:
    """A spoiled grid world, as it is in the files of its robots."""
    graph = pgo.grid_world(num_robots, 25, np.random.default_rng(seed), d=d)
    graph, _ = spoiled(graph, 0.4, kind, seed)
    write_g2o_folder(graph, folder)
    return read_g2o(folder, trust_folder=True)


def consistent(graph: PoseGraph) -> BoolArray:
    """Edges that pairwise consistency keeps, with edges in the order in which robots have them."""
    turns = graph.R_ij.reshape(graph.num_edges, -1)
    in_order = np.lexsort([*graph.t_ij.T, *turns.T, graph.i, graph.j])
    kept = np.empty(graph.num_edges, dtype=bool)
    kept[in_order] = pairwise_consistent(graph.edge_subgraph(in_order).with_robots(graph.robots))
    return kept


def edges_of(graph: PoseGraph) -> set[tuple[object, ...]]:
    """Edges by their ends and what they measure."""
    ids = graph.pose_ids
    rows = zip(ids[graph.i], ids[graph.j], graph.R_ij, graph.t_ij, strict=True)
    return {(int(i), int(j), R.tobytes(), t.tobytes()) for i, j, R, t in rows}


@settings(max_examples=examples(10), deadline=None)
@given(seed=SEEDS, d=DIMENSIONS, kind=st.sampled_from(["random", "aliased"]))
def test_the_robots_keep_what_pairwise_consistency_of_the_whole_graph_keeps(
    tmp_path_factory: pytest.TempPathFactory, seed: int, d: int, kind: str
) -> None:
    folder = tmp_path_factory.mktemp("world")
    graph = world(seed, d, kind, folder)
    expected = consistent(graph)
    engine = Recording()
    solution = solvers.solve_folder(
        folder, robust=solvers.PCM(), robots=solvers.Robots(engine=engine), trust_folder=True
    )
    parts = [agent.known(OwnGraph).graph for agent in engine.agents]
    kept = set().union(*(edges_of(part) for part in parts))
    assert kept == edges_of(graph.without_edges(~expected))
    assert solution.num_rejected == (~expected).sum()
    for a, part in enumerate(parts):  # both robots keep the same
        for b, other in enumerate(parts):
            own = {int(pose) for pose in graph.pose_ids[graph.robots == a]}
            theirs = {int(pose) for pose in graph.pose_ids[graph.robots == b]}
            between = [
                {e for e in edges_of(g) if {e[0], e[1]} & own and {e[0], e[1]} & theirs}
                for g in (part, other)
            ]
            if a != b:
                assert between[0] == between[1]


def test_a_folder_with_wrong_closures_is_solved_for_those_that_agree(tmp_path: Path) -> None:
    graph = pgo.grid_world(3, 40, np.random.default_rng(1), d=2)
    wrong, _ = spoiled(graph, 0.3, "random", 1)
    write_g2o_folder(wrong, tmp_path / "in")
    solution = solvers.solve_folder(tmp_path / "in", robust=solvers.PCM(), trust_folder=True)
    kept = consistent(read_g2o(tmp_path / "in", trust_folder=True))
    assert solution.num_rejected == (~kept).sum() > 0
    assert solution.sizes[1].sum() == kept.sum()
    expected = solvers.solve(read_g2o(tmp_path / "in", trust_folder=True).without_edges(~kept))
    assert solution.certificate.objective == pytest.approx(expected.objective, rel=1e-6)
    text = str(solution)
    assert "for the edges that were kept" in text
    assert f"{solution.num_rejected} of {wrong.num_edges} edges left out" in text
    assert "closures" not in str(solvers.solve_folder("robots"))


def test_closures_between_several_pieces_of_trajectories_are_judged_apart(tmp_path: Path) -> None:
    # Robot 0 has two pieces of odometry, robot 1 six; no measurement is wrong.
    pieces = np.array([0] * 3 + [1] * 3 + [k for k in range(2, 8) for _ in range(2)])
    ids = np.arange(len(pieces)) + 10 * pieces
    truth = pgo.grid_world(1, len(pieces), np.random.default_rng(0), d=2).truth
    assert truth is not None
    pairs = [(k, k + 1) for k in range(len(pieces) - 1) if pieces[k] == pieces[k + 1]]
    pairs += [(0, 6 + 2 * 5), (3, 6 + 2 * 1), (1, 4), *((6, 6 + 2 * k) for k in range(1, 6))]
    i, j = np.array(pairs).T
    R = np.swapaxes(truth.R[i], 1, 2) @ truth.R[j]
    t = np.einsum("eba,eb->ea", truth.R[i], truth.t[j] - truth.t[i])
    ones = np.ones(len(i))
    graph = PoseGraph(len(pieces), i, j, R, t, 100.0 * ones, 100.0 * ones, ids=ids)
    write_g2o_folder(graph.with_robots((pieces > 1).astype(int)), tmp_path / "in", truth)
    assert solvers.solve_folder(tmp_path / "in", robust=solvers.PCM()).num_rejected == 0


@pytest.mark.parametrize("robust", [solvers.PCM(), solvers.GNC()])
def test_a_robot_may_have_no_edge_of_its_own(
    tmp_path: Path, robust: solvers.PCM | solvers.GNC
) -> None:
    graph = pgo.grid_world(1, 30, np.random.default_rng(0), d=2)
    owners = np.repeat([0, 1, 2], [15, 1, 14])
    write_g2o_folder(graph.with_robots(owners), tmp_path / "in", graph.truth)
    assert solvers.solve_folder(tmp_path / "in", robust=robust).certificate.is_certified


def test_what_robots_with_files_cannot_judge_is_refused() -> None:
    known = np.ones(212, dtype=bool)
    for robust in (solvers.GNC(known=known), solvers.PCM(known=known)):
        with pytest.raises(SettingError, match=r"no other known edges; .* --split given"):
            solvers.solve_folder("robots", robust=robust)


def test_the_only_edge_between_two_robots_is_told(tmp_path: Path) -> None:
    for num_between, num_bridges in ((1, 1), (2, 0)):
        folder = tmp_path / f"{num_between}"
        write_g2o_folder(joined_by(num_between), folder)
        for robust in (solvers.PCM(), solvers.GNC()):
            solution = solvers.solve_folder(folder, robust=robust, trust_folder=True)
            assert solution.num_bridges == num_bridges
            told = "one edge is the only one between two parts of the map" in solution.robust
            assert told == bool(num_bridges)


def test_a_team_that_keeps_its_measurements_finds_wrong_ones_pair_by_pair(tmp_path: Path) -> None:
    graph = world(2, 2, "random", tmp_path)
    robots = robots_with_files(
        tmp_path, 3, sharing=solvers.Sharing.INTERFACE, robust=solvers.PCM(), retry=0.3
    )
    network = Network(robots, np.random.default_rng(0), lost=0.2)
    network.run(100.0)
    kept = consistent(graph)
    num_wrong = int((~kept).sum())
    wrong = np.stack([graph.pose_ids[graph.i], graph.pose_ids[graph.j]], axis=1)[~kept]
    told = {pair for robot in robots.values() for pair in robot.rejected}
    assert told == {(int(i), int(j)) for i, j in wrong}
    for robot in robots.values():
        assert robot.solution is not None
        assert robot.solution.certificate.is_certified
        assert robot.is_certified == robot.solution.is_held
        assert robot.solution.robust.startswith(f"{num_wrong} of {graph.num_edges} edges left out")
