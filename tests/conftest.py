"""Fixtures that several test files share."""

import inspect
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
from browser import Browser, find_browser
from budget import EXAMPLES, PROFILE
from hypothesis import settings

from pgo_models.geometry.poses import Poses
from pgo_models.graphs.g2o import read_g2o
from pgo_models.problem.cholesky import CholeskyBackend, default_backend
from pgo_models.problem.cholmod import import_cvxopt
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.cli import app as cli
from solvers.riemannian.polish import polish

# Speed is measured in benchmarks.
settings.register_profile(PROFILE, max_examples=EXAMPLES, deadline=None)
settings.load_profile(PROFILE)


# A test that asks for one of these may come out otherwise with the benchmark files.
BENCHMARK_FIXTURES = {"benchmark_data", "benchmark_problem", "benchmark_optimum"}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--rest",
        action="store_true",
        help=(
            "only what `pytest` alone leaves out or cuts short: slow tests, tests that draw"
            " examples, and tests that read the public benchmark graphs"
        ),
    )


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--rest"):
        config.option.markexpr = ""  # instead of "not slow"
    # Before a test module imports CVXOPT, whose OpenBLAS would then choose other kernels than those
    # of the processes that tests start: last bits would differ on CPUs with AVX-512.
    if default_backend() is CholeskyBackend.CHOLMOD:
        import_cvxopt()


def parameters_of(item: pytest.Item) -> tuple[str, ...]:
    """Names of the fixtures and parameters that the function of a test itself asks for."""
    test = getattr(item, "function", None)
    return () if test is None else tuple(inspect.signature(test).parameters)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--rest"):
        return
    chosen: list[pytest.Item] = []
    left_out: list[pytest.Item] = []
    for item in items:
        is_drawn = getattr(getattr(item, "obj", None), "is_hypothesis_test", False)
        is_measured = bool(BENCHMARK_FIXTURES & set(getattr(item, "fixturenames", ())))
        # `request` can ask for any of them. Fixtures of pytest, as `tmp_path`, ask for it, too, so
        # that it counts only where the test itself does.
        is_measured |= "request" in parameters_of(item)
        is_slow = item.get_closest_marker("slow") is not None
        (chosen if is_drawn or is_measured or is_slow else left_out).append(item)
    config.hook.pytest_deselected(items=left_out)
    items[:] = chosen


@pytest.fixture(scope="session")
def benchmark_data() -> Path:
    """Folder with the public benchmark graphs."""
    folder = os.environ.get("PGO_DATA")
    if not folder:
        pytest.skip("PGO_DATA is unset; it names the folder with the public benchmark graphs")
    return Path(folder)


@pytest.fixture(scope="session")
def benchmark_problem(benchmark_data: Path) -> Callable[[str], PGOProblem]:
    """Problem of F of a public benchmark graph, read once."""
    return cache(
        lambda name: PGOProblem(
            read_g2o(benchmark_data / f"{name}.g2o"), weighting=Weighting.ISOTROPIC
        )
    )


@pytest.fixture(scope="session")
def benchmark_optimum(benchmark_problem: Callable[[str], PGOProblem]) -> Callable[[str], Poses]:
    """Stationary poses that the chordal start of a benchmark graph polishes to, found once."""
    return cache(
        lambda name: polish(benchmark_problem(name), chordal_start(benchmark_problem(name)))
    )


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if find_browser() is None:
        pytest.skip("no chromium or chrome on PATH to open the page in")
    with Browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture
def pgo_command(capsys):
    """Runs `pgo` in this process: exit code, standard output, standard error."""

    def call(*arguments):
        with pytest.raises(SystemExit) as end:
            cli.main([str(argument) for argument in arguments])
        streams = capsys.readouterr()
        return end.value.code, streams.out, streams.err

    return call
