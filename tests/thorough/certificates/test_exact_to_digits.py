"""A file that writes measurements without noise in 8 to 12 digits is EXACT to these digits.

And nothing else is: neither noise that shows, nor poses that fit some edges only, nor few digits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from exact_arithmetic import ExactGraph, exact
from graphs import DIMENSIONS, SEEDS, exact_graph, informed, random_poses
from hypothesis import given, settings, strategies as st
from written import write_robot_files, written_text

import pgo_models as pgo
import solvers
from pgo_models import Certificate, PGOProblem, PoseGraph, Poses, Verdict, Weighting
from pgo_models.certificates.fit import FITS_WITHOUT_EDGES, NO_FIT, Fit
from solvers.cli.app import main

SQUARE = "".join(
    f"EDGE_SE2 {i} {j} 1 0 1.570796327 1 0 0 1 0 1\n" for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))
)
FORMATS = [f"%.{digits}{kind}" for digits in (8, 9, 10, 12) for kind in "fg"]


def read(graph: PoseGraph, form: str, folder: Path) -> PoseGraph:
    """The graph as it is read from a file with this format."""
    path = folder / "graph.g2o"
    path.write_text(written_text(graph, form))
    return pgo.read_g2o(path)


def without_noise(pattern: PoseGraph) -> PoseGraph:
    """The graph whose edges, with their matrices, measure the true relative poses."""
    truth = pattern.truth
    assert truth is not None
    back = truth.R[pattern.i].mT
    t_ij = np.einsum("mab,mb->ma", back, truth.t[pattern.j] - truth.t[pattern.i])
    return replace(pattern, R_ij=back @ truth.R[pattern.j], t_ij=t_ij)


def assert_exact_to_digits(certificate: Certificate) -> None:
    """The verdict, its sentence, and a gap of which no more is said than is proven."""
    assert certificate.verdict is Verdict.EXACT
    assert certificate.fit.is_exact
    assert certificate.fit.units <= 2.0
    assert "globally optimal: every edge fits to " in certificate.verdict_text
    assert certificate.is_certified
    assert not certificate.can_improve
    cost = exact(certificate.objective_at_most)
    assert (1 - exact(certificate.proven_gap)) * cost <= exact(certificate.lower_bound)
    assert certificate.gap_text.endswith("of a cost that the last digits of the edges explain")


@settings(max_examples=examples(25))
@given(
    seed=SEEDS,
    n=st.integers(3, 20),
    d=DIMENSIONS,
    form=st.sampled_from(FORMATS),
    spread=st.sampled_from([0.0, 1.0, 2.0]),
    size=st.sampled_from([1.0, 100.0]),
)
def test_graphs_without_noise_are_exact_to_the_digits_of_their_file(
    seed: int,
    n: int,
    d: int,
    form: str,
    spread: float,
    size: float,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    graph = exact_graph(seed, n, d)
    kappa, tau = 10.0 ** np.random.default_rng(seed).uniform(-spread, spread, (2, graph.num_edges))
    tau = tau / size**2
    graph = replace(graph, t_ij=size * graph.t_ij, kappa=kappa, tau=tau)
    problem = PGOProblem(read(graph, form, tmp_path_factory.mktemp("digits")))
    solution = solvers.solve(problem, progress=False)
    certificate = solution.certificate
    if not certificate.fit.is_to_rounding:  # all numbers of a small graph may be that of a double
        assert_exact_to_digits(certificate)
    judged = solvers.certify(problem, solution.poses)
    assert (judged.verdict, judged.fit) == (certificate.verdict, certificate.fit)
    # What is left is at most what half a unit of the last digit makes, in exact arithmetic.
    written = problem.graph.written_error
    assert written is not None
    allowed = float(np.sum(problem.graph.tau * written[:, 0] ** 2))
    allowed += float(np.sum(problem.graph.kappa * written[:, 1] ** 2))
    cost = ExactGraph.of_doubles(problem.graph).objective_of(solution.poses)
    assert cost <= exact(allowed * (1.0 + 1e-9)) + 4 * exact(certificate.rounding_level)


DOORS: dict[str, Callable[[PoseGraph, Path], Certificate]] = {
    "robots": lambda graph, _: solvers.solve(graph, robots=3, progress=False).certificate,
    "certify": lambda graph, _: solvers.certify(graph, solvers.solve(graph, progress=False).poses),
    "robust": lambda graph, _: (
        solvers.solve(graph, robust=solvers.GNC(), progress=False).certificate
    ),
    "rotations": lambda graph, _: (
        solvers.solve(PGOProblem(graph, weighting=Weighting.ROTATIONS), progress=False).certificate
    ),
    "extended": lambda graph, _: (
        solvers.extend(
            solvers.solve(graph.subgraph(np.arange(10)), progress=False), graph
        ).certificate
    ),
    "own files": lambda graph, folder: (
        solvers.solve_folder(write_robot_files(graph, folder, "%.9f"), progress=False).certificate
    ),
    "read together": lambda graph, folder: (
        solvers.solve(
            pgo.read_g2o(write_robot_files(graph, folder, "%.9f")), progress=False
        ).certificate
    ),
}


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("door", DOORS)
def test_they_are_exact_through_every_door(door: str, d: int, tmp_path: Path) -> None:
    graph = read(exact_graph(3, 14, d), "%.9f", tmp_path)
    assert_exact_to_digits(DOORS[door](graph, tmp_path / "robots"))


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("robots", [None, 2])
@pytest.mark.parametrize("coupled", [False, True])
def test_chi2_is_exact_to_the_digits(
    coupled: bool, robots: int | None, d: int, tmp_path: Path
) -> None:
    graph = read(without_noise(informed(3, 12, d, coupled, 1.0)), "%.9g", tmp_path)
    problem = PGOProblem(graph, weighting=Weighting.INFORMATION)
    assert_exact_to_digits(solvers.solve(problem, robots=robots, progress=False).certificate)


@pytest.mark.parametrize("robots", [None, 2])
def test_priors_and_landmarks_are_written_with_digits_too(
    robots: int | None, tmp_path: Path
) -> None:
    graph = exact_graph(3, 14, 2)
    truth = graph.truth
    assert truth is not None
    lines = [
        f"EDGE_PRIOR_SE2_XY {pose} {x:.9f} {y:.9f} 1 0 1"
        for pose, (x, y) in enumerate(truth.t.tolist())
    ]
    landmark = np.array([0.3, -0.4])
    for pose in (2, 5, 9):
        x, y = (landmark - truth.t[pose]) @ truth.R[pose]
        lines.append(f"EDGE_SE2_XY {pose} 99 {x:.9f} {y:.9f} 1 0 1")
    path = tmp_path / "gps.g2o"
    path.write_text(written_text(graph, "%.9f") + "\n".join(lines) + "\n")
    solution = solvers.solve(pgo.read_g2o(path), robots=robots, progress=False)
    assert_exact_to_digits(solution.certificate)


def test_a_student_s_first_square_is_exact(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "square.g2o"
    path.write_text(SQUARE)
    for options in ([], ["--cost", "isotropic"], ["--robots", "2"], ["--rotations"]):
        with pytest.raises(SystemExit) as ended:
            main(["solve", str(path), *options])
        assert ended.value.code == 0
        assert "globally optimal: every edge fits to " in capsys.readouterr().out
    record = solvers.solve(pgo.read_g2o(path), progress=False).as_json()
    assert record["verdict"] == "EXACT"
    assert 0.0 < record["exact_to"] < 1e-9
    assert record["proven_gap"] > 1e-6


@pytest.mark.parametrize("form", ["%.2f", "%.4f", "%.6f", "%.6g", "%.17g"])
def test_few_digits_and_those_of_doubles_are_no_reason_to_say_so(form: str, tmp_path: Path) -> None:
    for seed in range(4):
        graph = read(exact_graph(seed, 12, 2 + seed % 2), form, tmp_path)
        assert np.isinf(solvers.solve(graph, progress=False).certificate.fit.units)


def test_the_same_numbers_without_a_file_are_not_exact(tmp_path: Path) -> None:
    graph = read(exact_graph(0, 12, 2), "%.9f", tmp_path)
    unknown = replace(graph, written_error=None)
    assert solvers.solve(graph, progress=False).certificate.fit.is_exact
    assert not solvers.solve(unknown, progress=False).certificate.fit.is_exact


@settings(max_examples=examples(15))
@given(seed=SEEDS, d=DIMENSIONS, units=st.floats(30.0, 1e6))
def test_noise_above_the_last_digit_is_not_exact(
    seed: int, d: int, units: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """The noise is in translations alone, and what the digits make of heavier rotations counts."""
    graph = exact_graph(seed, 12, d)
    noise = 1e-9 * units * np.random.default_rng(seed).standard_normal(graph.t_ij.shape)
    noisy = read(replace(graph, t_ij=graph.t_ij + noise), "%.9f", tmp_path_factory.mktemp("noise"))
    assert not solvers.solve(noisy, progress=False).certificate.fit.is_exact


@settings(max_examples=examples(15))
@given(seed=SEEDS, d=DIMENSIONS, weight=st.sampled_from([1e-60, 1e-30, 1.0, 1e30, 1e60]))
def test_weights_have_no_say(
    seed: int, d: int, weight: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Random poses with tiny weights cost next to nothing, and fit no edge all the same."""
    graph = read(exact_graph(seed, 12, d), "%.9f", tmp_path_factory.mktemp("weights"))
    scaled = replace(graph, kappa=weight * graph.kappa, tau=weight * graph.tau, information=None)
    problem = PGOProblem(scaled)
    assert solvers.solve(problem, progress=False).certificate.fit.is_exact
    for poses in (random_poses(12, d, seed), Poses.identity(12, d)):
        certificate = solvers.certify(problem, poses)
        assert not certificate.fit.is_exact
        assert not certificate.is_certified


@pytest.mark.parametrize("far", range(4))
def test_digits_of_a_long_edge_excuse_no_other(far: int, tmp_path: Path) -> None:
    """Of 1e9 m the ninth digit is metres; the other edges have theirs."""
    names = [pose for pose in range(4) if pose != far]
    a, b, c = names
    edges = [(a, b, "1.00000001 0"), (b, c, "0 1"), (a, c, "1 1"), (a, far, "1000000000 0")]
    path = tmp_path / "far.g2o"
    path.write_text("".join(f"EDGE_SE2 {i} {j} {t} 0 1e12 0 0 1e12 0 1e12\n" for i, j, t in edges))
    graph = pgo.read_g2o(path)
    assert graph.written_error is not None
    t = np.zeros((4, 2))
    t[[b, c, far]] = [[1.0, 0.0], [1.0, 1.0], [1e9, 0.0]]
    straight = np.tile(np.eye(2), (4, 1, 1))
    assert solvers.certify(graph, Poses(straight, t)).fit.is_exact
    t[c, 0] += 1e-5
    off = solvers.certify(graph, Poses(straight, t))
    assert not off.is_certified


def test_a_heavy_edge_does_not_hide_light_ones(tmp_path: Path) -> None:
    graph = exact_graph(1, 10, 3)
    assert graph.truth is not None
    first = np.arange(graph.num_edges) == 0
    heavy = read(replace(graph, tau=np.where(first, 1e30, 1.0), information=None), "%.9f", tmp_path)
    assert solvers.certify(heavy, graph.truth).fit.is_exact
    t = graph.truth.t.copy()
    free = np.setdiff1d(np.arange(10), [graph.i[0], graph.j[0]])[0]
    t[free, 0] += 1e-6
    assert PGOProblem(heavy).objective(Poses(graph.truth.R, t)) < 1e12
    assert not solvers.certify(heavy, Poses(graph.truth.R, t)).fit.is_exact


def test_a_robust_solve_says_to_what_it_is_exact(tmp_path: Path) -> None:
    graph = read(exact_graph(3, 14, 2), "%.12g", tmp_path)
    robust = solvers.solve(graph, robust=solvers.GNC(), progress=False).robust
    assert robust is not None
    assert "EXACT for " in robust.headline


def test_the_loosest_of_several_fits_is_that_of_all() -> None:
    exact = Fit(is_exact=True, share=1e-10, units=0.5)
    assert Fit.of_all([]) == FITS_WITHOUT_EDGES
    assert Fit.of_all([FITS_WITHOUT_EDGES, exact]) == exact
    assert not Fit.of_all([NO_FIT, FITS_WITHOUT_EDGES]).is_exact


CASES = Path(__file__).parents[2] / "cases"


def test_a_fix_that_is_off_by_three_of_its_units_is_not_exact() -> None:
    """Its last digit is a metre, and it is 3.3 m off among a hundred fixes."""
    certificate = solvers.solve(
        pgo.read_g2o(CASES / "exact_wrong_fix.g2o"), progress=False
    ).certificate
    assert certificate.objective > 1000.0
    assert certificate.verdict is not Verdict.EXACT
    square = solvers.solve(
        pgo.read_g2o(CASES / "q1_noise_free_square.g2o"), progress=False
    ).certificate
    assert square.verdict is Verdict.EXACT
