"""Versions of the software that computed a result, for records."""

import os
import platform
import re
from contextlib import suppress
from importlib import metadata

from pgo_models.problem.cholesky import CholeskyBackend, default_backend
from pgo_models.problem.kernels import chosen_kernels

_DISTRIBUTION = "pgo-splitting"


def installed_version(distribution: str = _DISTRIBUTION) -> str:
    """Version of an installed distribution, or "missing"."""
    with suppress(metadata.PackageNotFoundError):
        return metadata.version(distribution)
    return "missing"


def installation() -> list[tuple[str, str]]:
    """Rows that `pgo info` prints of this installation: label and text of each.

    They are versions, back ends, threads, and the packages of every extra.
    """
    limits = []
    for name, value in sorted(os.environ.items()):
        if name.endswith("_NUM_THREADS"):
            limits.append(f"{name}={value}")
    rows = list(installed_versions(None).items())
    rows.append(("threads", ", ".join([f"{os.cpu_count()} CPUs", *limits])))
    for extra, packages in _packages_of_extras().items():
        versions = [f"{name} {installed_version(name)}" for name in packages]
        rows.append((f"extra {extra}", ", ".join(versions)))
    return rows


def _packages_of_extras() -> dict[str, list[str]]:
    """Names of the packages that every extra requires; empty if this package is not installed."""
    packages: dict[str, list[str]] = {}
    with suppress(metadata.PackageNotFoundError):
        for requirement in metadata.requires(_DISTRIBUTION) or ():
            # for example: matplotlib>=3.8; extra == "plot"
            pattern = r"""^([\w.-]+)[^\[]*; extra == ["'](\w+)"""
            for name, extra in re.findall(pattern, requirement):
                packages.setdefault(extra, []).append(name)
    return packages


def installed_versions(backend: CholeskyBackend | None) -> dict[str, str]:
    """Versions of the software that computed a result, by name."""
    versions = {"python": platform.python_version()}
    for name in (_DISTRIBUTION, "numpy", "scipy", "cvxpy", "clarabel"):
        versions[name] = installed_version(name)
    chosen = backend or default_backend()
    kernels = chosen_kernels()
    versions["cholesky"] = chosen.value
    if chosen is CholeskyBackend.CHOLMOD and kernels:
        versions["cholesky"] += f", {kernels} kernels"
    return versions
