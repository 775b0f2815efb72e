"""Fixtures that several test files share."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def benchmark_data() -> Path:
    """Folder with the public benchmark graphs."""
    folder = os.environ.get("PGO_DATA")
    if not folder:
        pytest.skip("PGO_DATA is unset; it names the folder with the public benchmark graphs")
    return Path(folder)
