"""The installed distribution: its version, and those of the packages that it requires."""

import re
from contextlib import suppress
from importlib import metadata

DISTRIBUTION = "pgo-splitting"


def installed_version(distribution: str = DISTRIBUTION) -> str:
    """Version of an installed distribution, or "missing"."""
    with suppress(metadata.PackageNotFoundError):
        return metadata.version(distribution)
    return "missing"


def packages_of_extras() -> dict[str, list[str]]:
    """Names of the packages that every extra requires; empty if this package is not installed."""
    packages: dict[str, list[str]] = {}
    with suppress(metadata.PackageNotFoundError):
        for requirement in metadata.requires(DISTRIBUTION) or ():
            # for example: matplotlib>=3.8; extra == "plot"
            pattern = r"""^([\w.-]+)[^\[]*; extra == ["'](\w+)"""
            for name, extra in re.findall(pattern, requirement):
                packages.setdefault(extra, []).append(name)
    return packages
