"""How objects with large fields are shown: a word or two for every field, in a few lines.

`repr` has them one after the other, notebooks a table with a row for each.
"""

import dataclasses
import enum
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from scipy.sparse import csc_array, csr_array

from pgo_models.html_tables import facts_table

_WIDTH = 100  # letters of a line, as in the code
_MOST_LETTERS = 60  # of a field
_FEW = 4  # numbers of an array, or entries of a list, that are shown one by one


class Summarised:
    """Base of dataclasses whose fields may be large; one with a `__repr__` of its own keeps it."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        # A dataclass leaves a `__repr__` alone that its class has itself.
        if "__repr__" not in vars(cls):
            cls.__repr__ = cls.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        lines = [f"{type(self).__name__}("]
        facts = [f"{name}={text}" for name, text in self._facts()]
        for fact, end in zip(facts, [*[", "] * (len(facts) - 1), ")"], strict=True):
            if len(lines[-1] + fact + end) > _WIDTH:
                lines.append("    ")
            lines[-1] += fact + end
        return "\n".join(line.rstrip() for line in lines)

    def _repr_html_(self) -> str:
        return f"<p>{type(self).__name__}</p>{facts_table(self._facts())}"

    def _facts(self) -> list[tuple[str, str]]:
        """Name and short text of every field."""
        facts = []
        for field in dataclasses.fields(cast(Any, self)):
            if field.repr and not field.name.startswith("_"):
                facts.append((field.name, _in_short(getattr(self, field.name))))
        return facts


def _in_short(value: object) -> str:
    if isinstance(value, np.ndarray) and value.size > _FEW:
        return f"array {value.shape}"
    if isinstance(value, csr_array | csc_array):
        return f"sparse array {value.shape} with {value.nnz} entries"
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple | list):
        return _list_in_short(value)
    if isinstance(value, dict):
        return f"{len(value)} entries"
    is_large = dataclasses.is_dataclass(value) and not isinstance(value, Summarised)
    shown = "" if is_large else " ".join(repr(value).split())
    if shown and len(shown) <= _MOST_LETTERS:
        return shown
    return f"{type(value).__name__}(..)"


def _list_in_short(values: Sequence[object]) -> str:
    if len(values) <= _FEW:
        shown = f"({', '.join(map(_in_short, values))})"
        if len(shown) <= _MOST_LETTERS:
            return shown
    return f"{len(values)} of {type(values[0]).__name__}"
