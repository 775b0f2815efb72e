"""Letters of the splitting methods (`notebooks/site/guide/letters.md`) stand for nothing else."""

import re
from pathlib import Path

import pytest

import pgo_models

# The penalty, the over-relaxation, the orthogonal copy, and the map of Bregman iteration.
OF_SPLITTING = re.compile(r"\b(?:rho|alpha|omega|K)(?:_\w+)?\b")
# Rooms in which nothing is split yet.
ROOMS = ("graphs", "problem", "certificates", "relaxations")


@pytest.mark.parametrize("room", ROOMS)
def test_where_nothing_is_split_no_letter_of_splitting_is_used(room: str) -> None:
    used = {
        (file.name, letter)
        for file in (Path(pgo_models.__file__).parent / room).glob("*.py")
        for letter in OF_SPLITTING.findall(file.read_text(encoding="utf-8"))
    }
    assert used == set()
