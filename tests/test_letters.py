"""Letters of the splitting methods (`notebooks/site/guide/letters.md`) stand for nothing else."""

import re
from pathlib import Path

import pytest

import pgo_models

ROOT = Path(pgo_models.__file__).parent.parent
# The penalty, the over-relaxation, the orthogonal copy, and the map of Bregman iteration.
OF_SPLITTING = ("rho", "alpha", "omega", "K")
# Rooms, and the letters whose meaning they have no use for: in the first ones nothing is split,
# Q has the translations marginalised, and Bregman iteration (J, K, f) has a room of its own.
ROOMS = {
    "pgo_models/geometry": ("rho", "alpha", "K", "Q"),
    "pgo_models/graphs": (*OF_SPLITTING, "Q"),
    "pgo_models/problem": OF_SPLITTING,
    "pgo_models/certificates": OF_SPLITTING,
    "pgo_models/relaxations": OF_SPLITTING,
    "pgo_models/verification": (*OF_SPLITTING, "Q"),
    "solvers/soc": ("K",),
    "solvers/riemannian": OF_SPLITTING,
    "solvers/handedness": ("alpha", "omega", "K"),
    "solvers/robust": (*OF_SPLITTING, "Q"),
}


@pytest.mark.parametrize("room", ROOMS)
def test_a_letter_is_not_used_where_its_meaning_has_no_place(room: str) -> None:
    letters = re.compile(rf"\b(?:{'|'.join(ROOMS[room])})(?:_\w+)?\b")
    files = list((ROOT / room).glob("*.py"))
    assert files
    used = {
        (file.name, letter)
        for file in files
        for letter in letters.findall(file.read_text(encoding="utf-8"))
    }
    assert used == set()
