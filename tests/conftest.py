"""Fixtures that several test files share."""

import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
from browser import Browser, find_browser
from budget import EXAMPLES, PROFILE
from hypothesis import settings

from pgo_models import PGOProblem, Poses, Weighting, chordal_start, read_g2o
from pgo_models.problem.cholesky import CholeskyBackend, default_backend
from pgo_models.problem.cholmod import import_cvxopt
from solvers import polish
from solvers.cli import app as cli

# Speed is measured in benchmarks.
settings.register_profile(
    PROFILE,
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=PROFILE == "fixed",
    database=None,
)
settings.load_profile(PROFILE)


def pytest_configure(config: pytest.Config) -> None:
    # Before a test module imports CVXOPT, whose OpenBLAS would then choose other kernels than those
    # of the processes that tests start: last bits would differ on CPUs with AVX-512.
    if default_backend() is CholeskyBackend.CHOLMOD:
        import_cvxopt()


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
