"""Versions of what computed a result, for records."""

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
    """What `pgo info` says of this installation, label and text: versions, back ends, threads, and every extra."""
    limits = (f"{name}={value}" for name, value in sorted(os.environ.items()) if name.endswith("_NUM_THREADS"))
    rows = [*installed_versions(None).items(), ("threads", ", ".join([f"{os.cpu_count()} CPUs", *limits]))]
    extras: dict[str, list[str]] = {}
    with suppress(metadata.PackageNotFoundError):
        for needed in metadata.requires(_DISTRIBUTION) or ():
            for name, extra in re.findall(r"""^([\w.-]+)[^\[]*; extra == ["'](\w+)""", needed):
                extras.setdefault(extra, []).append(f"{name} {installed_version(name)}")
    return rows + [(f"extra {extra}", ", ".join(found)) for extra, found in extras.items()]


def installed_versions(backend: CholeskyBackend | None) -> dict[str, str]:
    """Versions of what computed a result, for records."""
    names = (_DISTRIBUTION, "numpy", "scipy", "cvxpy", "clarabel")
    found = {"python": platform.python_version(), **{name: installed_version(name) for name in names}}
    chosen, kernels = backend or default_backend(), chosen_kernels()
    has_kernels = chosen is CholeskyBackend.CHOLMOD and kernels
    return {**found, "cholesky": f"{chosen.value}, {kernels} kernels" if has_kernels else chosen.value}
