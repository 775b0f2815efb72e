"""Versions of the software that computed a result, for records."""

import os
import platform

from pgo_models.problem.cholesky import CholeskyBackend, default_backend
from solvers.reporting.distribution import DISTRIBUTION, installed_version, packages_of_extras


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
    for extra, packages in packages_of_extras().items():
        versions = [f"{name} {installed_version(name)}" for name in packages]
        rows.append((f"extra {extra}", ", ".join(versions)))
    return rows


def installed_versions(backend: CholeskyBackend | None) -> dict[str, str]:
    """Versions of the software that computed a result, by name."""
    versions = {"python": platform.python_version()}
    for name in (DISTRIBUTION, "numpy", "scipy", "cvxpy", "clarabel"):
        versions[name] = installed_version(name)
    chosen = backend or default_backend()
    versions["cholesky"] = chosen.value
    return versions
