"""Beside the verdict stands whether the measurements fit: a certificate does not ask."""

from dataclasses import replace

import pytest

import pgo_models as pgo
import solvers


@pytest.fixture(scope="module")
def world() -> pgo.PoseGraph:
    return pgo.grid_world(1, 80, 0, d=2)


@pytest.fixture(scope="module")
def with_wrong_edge(world: pgo.PoseGraph, tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("fit") / "house.g2o"
    pgo.write_g2o(world, path)
    with path.open("a") as file:
        file.write("EDGE_SE2 5 61 0 0 0 100 0 0 100 0 400\n")
    return str(path)


def rows_of(text: str) -> dict[str, str]:
    return {line[:12].strip(): line[13:] for line in text.splitlines() if line}


def test_a_misfit_is_certified_and_doubtful(with_wrong_edge: str) -> None:
    solution = solvers.solve(pgo.load(with_wrong_edge))
    assert solution.verdict is pgo.Verdict.CERTIFIED
    assert solution.is_doubtful
    assert solution.fit_ratio == pytest.approx(solution.edge_residuals.overall)
    lines = str(solution).splitlines()
    (verdict,) = (k for k, line in enumerate(lines) if line.startswith("verdict"))
    assert "of measurements that do not fit" in lines[verdict]
    assert lines[verdict + 1].startswith(f"fit          {solution.fit_ratio:.3g} times")
    assert "DOUBTFUL" in lines[verdict + 1]
    assert "--robust gnc, or pgo doctor" in lines[verdict + 1]
    assert "DOUBTFUL" in repr(solution)
    record = solution.as_json()
    assert record["is_doubtful"] is True
    assert record["fit_ratio"] == solution.fit_ratio


def test_measurements_that_fit_are_told_without_a_doubt(world: pgo.PoseGraph) -> None:
    solution = solvers.solve(world)
    assert not solution.is_doubtful
    assert "DOUBTFUL" not in str(solution) + repr(solution)
    assert rows_of(str(solution))["fit"] == f"{solution.fit_ratio:.3g} times what is expected"
    assert "do not fit" not in str(solution)


def test_errors_far_below_their_deviations_are_told_without_a_doubt(world: pgo.PoseGraph) -> None:
    loose = replace(world, kappa=0.01 * world.kappa, tau=0.01 * world.tau)
    ratio = solvers.solve(world).fit_ratio / 100.0
    row = rows_of(str(solvers.solve(loose)))["fit"]
    assert row.startswith(f"{ratio:.3g} times what is expected; errors are {ratio**-0.5:.3g} times")


def test_what_is_exact_or_unchecked_has_no_row_of_its_fit(world: pgo.PoseGraph) -> None:
    tree = world.without_edges(world.j != world.i + 1)
    for graph in (tree, pgo.load("circle")):
        solution = solvers.solve(graph)
        has_ratio = solution.fit_ratio > 0.0
        assert ("fit" in rows_of(str(solution))) is has_ratio
    assert solvers.solve(tree).as_json()["fit_ratio"] is None


def test_doctor_proposes_a_robust_solve_where_no_reading_fits(with_wrong_edge, pgo_command) -> None:
    code, out, _ = pgo_command("doctor", with_wrong_edge)
    assert code == 0
    assert f"pgo solve {with_wrong_edge} --robust gnc" in " ".join(out.replace("\\", "").split())


def test_poses_that_a_limit_has_left_unfinished_are_no_reason_to_doubt_edges() -> None:
    graph = pgo.grid_world(1, 200, 0, d=2)
    odometry = pgo.odometry_start(graph)
    solution = solvers.solve(graph, start=odometry, time_limit=1e-9)
    assert solution.status is solvers.Status.TIME_LIMIT
    assert solution.edge_residuals.is_doubtful
    assert not solution.is_doubtful
    assert "DOUBTFUL" not in str(solution) + repr(solution)
    assert rows_of(str(solution))["fit"].endswith("at poses that the solve has not finished")
