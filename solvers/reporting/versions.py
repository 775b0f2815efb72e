"""Versions of what computed a result, for records."""

from __future__ import annotations

import platform
from contextlib import suppress
from importlib import metadata

from pgo_models.problem.cholesky import CholeskyBackend, default_backend


def installed_versions(backend: CholeskyBackend | None) -> dict[str, str]:
    """Versions of what computed a result, for records."""
    found = {"python": platform.python_version()}
    for name in ("pgo-splitting", "numpy", "scipy", "cvxpy", "clarabel"):
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return {**found, "cholesky": (backend or default_backend()).value}
