"""The list of mutants fits the project as it is; `tests/mutants.py` itself applies them."""

import pytest
from mutants import MUTANTS, ROOT, Mutant, chosen_mutants


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_mutant_replaces_text_that_stands_once_in_its_file(mutant: Mutant) -> None:
    text = (ROOT / mutant.file).read_text(encoding="utf-8")
    assert text.count(mutant.old) == 1
    assert mutant.new != mutant.old
    compile(text.replace(mutant.old, mutant.new), mutant.file, "exec")
    assert all((ROOT / test).is_file() for test in mutant.tests)


def test_a_sample_is_drawn_by_its_seed() -> None:
    assert chosen_mutants([], 3, 1) == chosen_mutants([], 3, 1)
    assert len({mutant.name for mutant in chosen_mutants([], 3, 1)}) == 3
    assert {mutant.name for mutant in chosen_mutants(["robots"], None, 0)} < {
        mutant.name for mutant in MUTANTS
    }
