"""Versions of what computed a result, for records."""

from __future__ import annotations

import platform
from importlib import metadata

from pgo_models.problem.cholesky import CholeskyBackend, default_backend


def versions(backend: CholeskyBackend | None) -> dict[str, str]:
    """Versions of what computed a result, for records."""
    names = ("pgo-splitting", "numpy", "scipy", "cvxpy", "clarabel")
    found = {name: metadata.version(name) for name in names if _is_installed(name)}
    return {"python": platform.python_version(), **found, "cholesky": (backend or default_backend()).value}


def _is_installed(name: str) -> bool:
    try:
        metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return False
    return True
