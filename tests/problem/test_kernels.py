"""CHOLMOD runs on the kernels of the CPU, and the environment stays as it was."""

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pgo_models.problem import kernels
from pgo_models.problem.cholesky import CholeskyBackend
from solvers.reporting.versions import installed_versions

PROGRAM = f"""
import ctypes, os
from pathlib import Path
from pgo_models.graphs.scenes import circle
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.problem import PGOProblem
import numpy as np
PGOProblem(circle(np.random.default_rng(0)), CholeskyBackend.CHOLMOD).analysis
import cvxopt
blas = next((Path(cvxopt.__file__).parents[1] / "cvxopt.libs").glob("libopenblas*"))
ask = ctypes.CDLL(str(blas)).openblas_get_corename
ask.restype = ctypes.c_char_p
print(ask().decode(), os.environ.get("{kernels.VARIABLE}"))
"""


def openblas() -> ctypes.CDLL | None:
    """The OpenBLAS of CVXOPT's wheel."""
    cvxopt = pytest.importorskip("cvxopt")
    found = list((Path(cvxopt.__file__).parents[1] / "cvxopt.libs").glob("libopenblas*"))
    return ctypes.CDLL(str(found[0])) if found else None


def kernels_in_a_process(**environment: str) -> list[str]:
    kept = {name: value for name, value in os.environ.items() if name != kernels.VARIABLE}
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, env={**kept, **environment}
    )
    return done.stdout.split()


@pytest.mark.skipif(kernels.chosen_kernels() is None, reason="a CPU without AVX2")
def test_cholmod_runs_on_the_kernels_of_the_cpu_unless_the_user_chose() -> None:
    if openblas() is None:
        pytest.skip("CVXOPT without the OpenBLAS of its wheel")
    assert kernels_in_a_process() == ["Haswell", "None"]
    assert kernels_in_a_process(**{kernels.VARIABLE: "Nehalem"}) == ["Nehalem", "Nehalem"]


@pytest.mark.parametrize(
    ("extensions", "chosen"),
    [
        ({"baseline": ["X86_V2"], "found": ["X86_V3", "X86_V4"]}, "Haswell"),
        ({"baseline": ["SSE", "SSE2"], "found": ["AVX", "FMA3", "AVX2"]}, "Haswell"),
        ({"baseline": ["X86_V3"]}, "Haswell"),
        ({"baseline": ["SSE", "SSE2"], "found": ["AVX"]}, None),
        ({"baseline": ["NEON"], "found": ["ASIMDHP"]}, None),
        ({}, None),
    ],
)
def test_kernels_are_asked_for_where_the_cpu_has_them(
    extensions: dict[str, list[str]], chosen: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(kernels.VARIABLE, raising=False)
    monkeypatch.setattr(np, "show_config", lambda mode: {"SIMD Extensions": extensions})
    assert kernels.chosen_kernels() == chosen
    monkeypatch.delitem(sys.modules, "cvxopt", raising=False)
    with kernels.kernels_of_the_cpu():
        assert os.environ.get(kernels.VARIABLE) == chosen
    assert kernels.VARIABLE not in os.environ
    monkeypatch.setenv(kernels.VARIABLE, "Zen")
    with kernels.kernels_of_the_cpu():
        assert os.environ[kernels.VARIABLE] == "Zen"
    assert (os.environ[kernels.VARIABLE], kernels.chosen_kernels()) == ("Zen", "Zen")


def test_kernels_are_said_beside_the_back_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(kernels.VARIABLE, "Zen")
    assert (
        installed_versions(CholeskyBackend.CHOLMOD)["cholesky"] == "CHOLMOD (CVXOPT), Zen kernels"
    )
    assert installed_versions(CholeskyBackend.SUPERLU)["cholesky"] == "SuperLU (scipy)"
