"""Versions of what computed a result, for records."""

import platform
from contextlib import suppress
from importlib import metadata

from pgo_models.problem.cholesky import CholeskyBackend, default_backend
from pgo_models.problem.kernels import chosen_kernels


def installed_versions(backend: CholeskyBackend | None) -> dict[str, str]:
    """Versions of what computed a result, for records."""
    found = {"python": platform.python_version()}
    for name in ("pgo-splitting", "numpy", "scipy", "cvxpy", "clarabel"):
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    chosen, kernels = backend or default_backend(), chosen_kernels()
    has_kernels = chosen is CholeskyBackend.CHOLMOD and kernels
    return {**found, "cholesky": f"{chosen.value}, {kernels} kernels" if has_kernels else chosen.value}
