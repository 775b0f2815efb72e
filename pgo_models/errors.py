"""The errors of the project, and checks of settings that raise them.

Each message says what was wrong, where, the value and the way out.
"""

import dataclasses
import importlib
import math
import typing
from collections.abc import Callable, Sequence
from enum import Enum
from numbers import Integral, Real
from pathlib import Path
from types import ModuleType
from typing import Any, cast

# How loaders of shared libraries say that memory ran out.
_OUT_OF_MEMORY = ("failed to map segment", "cannot allocate memory", "out of memory")
# Numbers of NumPy are taken where a float or an int is annotated.
_NUMBERS: dict[type, type] = {float: Real, int: Integral}

# What a setting must be, by the argument of `check_settings` that names it.
_RULES: dict[str, tuple[str, Callable[[float], bool]]] = {
    "positive": ("be positive", lambda value: value > 0),
    "finite": ("be positive and finite", lambda value: 0 < value < math.inf),
    "not_negative": ("not be negative", lambda value: value >= 0),
    "at_least_one": ("be at least 1", lambda value: value >= 1),
    "above_one": ("be above 1", lambda value: value > 1),
    "relaxation": ("be in (0, 2)", lambda value: 0 < value < 2),
}


class PGOError(Exception):
    """Root of every error that a wrong input or a missing piece raises here."""


class GraphError(PGOError):
    """A pose graph, or poses, that cannot be what they claim to be."""


class GraphWarning(UserWarning):
    """Warning that something in the files of a pose graph was left out or read otherwise."""


class SettingError(PGOError, ValueError):
    """A setting of a solver, a model or a scene that is out of its range.

    It is raised where the settings are made.
    """


class FileFormatError(PGOError):
    """A file that cannot be read; the message opens with `file:line`."""

    def __init__(self, path: Path | str, line: int | None, problem: str) -> None:
        """Name the place (`path`, 1-based `line`) and the `problem`, with value and way out."""
        place = printable(str(path))
        if line is not None:
            place = f"{place}:{line}"
        super().__init__(f"{place}: {problem}")
        self.path = Path(path)
        self.line = line
        self.problem = problem
        self._given = (path, line, problem)

    def __reduce__(self) -> "tuple[type[FileFormatError], tuple[Path | str, int | None, str]]":
        return type(self), self._given


class DatasetError(PGOError):
    """A named data set that is nowhere to be found, or whose checksum does not fit."""


class NotPositiveDefiniteError(PGOError):
    """A matrix that should have a Cholesky factorisation has none."""


class ProofError(PGOError):
    """Poses that cost less than a bound that was proved.

    This is a defect of the project, and never printed as a result.
    """


class EngineError(PGOError):
    """A place where robots run that cannot be reached, has no room for them, or loses them."""


class MissingExtraError(PGOError):
    """An optional dependency is not installed; the message names the extra.

    Whatever draws raises it without matplotlib or plotly, which the extra `plot` brings.
    """

    def __init__(self, package: str, extra: str) -> None:
        """Name the missing `package` and the `extra` that brings it."""
        super().__init__(f"{package} is not installed; run: pip install 'pgo-splitting[{extra}]'")
        self.extra = extra
        self._package = package

    def __reduce__(self) -> "tuple[type[MissingExtraError], tuple[str, str]]":
        return type(self), (self._package, self.extra)


def printable(text: str) -> str:
    """Text that no terminal takes for a command.

    A code stands in place of characters that steer a terminal, and of bytes that are no UTF-8.
    """
    if text.isprintable():
        return text
    return "".join(map(_printable_letter, text))


def _printable_letter(letter: str) -> str:
    if letter.isprintable():
        return letter
    # In names of files Python has the character 0xDC00 + b for a byte b, 0x80 or more, that is no
    # UTF-8.
    byte = ord(letter) - 0xDC00
    if 0x80 <= byte <= 0xFF:
        return f"\\x{byte:02x}"
    return letter.encode("unicode_escape").decode("ascii")


def extra_module(name: str, extra: str) -> ModuleType:
    """Module of a package that an extra brings, by its full name.

    A MissingExtraError where it is not installed, and a MemoryError where there is not enough
    memory to import it.
    """
    package = name.partition(".")[0]
    try:
        importlib.import_module(package)
        return importlib.import_module(name)
    except ImportError as error:
        if is_out_of_memory(error):
            raise MemoryError(f"{package} could not be imported: {error}") from error
        raise MissingExtraError(package, extra) from error


def is_out_of_memory(error: ImportError) -> bool:
    """Whether a module could not be imported because memory ran out."""
    return any(sign in str(error).lower() for sign in _OUT_OF_MEMORY)


def check_quantile(quantile: float) -> None:
    """Raise a SettingError unless a quantile is between 0 and 1."""
    if not 0.0 < quantile < 1.0:
        raise SettingError(
            f"quantile is {quantile!r}; give a probability between 0 and 1, such as 0.99"
        )


def check_settings(
    settings: object,
    *,
    positive: Sequence[str] = (),
    finite: Sequence[str] = (),
    not_negative: Sequence[str] = (),
    at_least_one: Sequence[str] = (),
    above_one: Sequence[str] = (),
    relaxation: Sequence[str] = (),
    of_any_type: Sequence[str] = (),
) -> None:
    """Raise a SettingError for the first field of a wrong type, or out of its range.

    The ranges are those of the fields that are named; None is in every range. Types are those of
    the annotations.
    """
    for field in dataclasses.fields(cast(Any, settings)):
        value = getattr(settings, field.name)
        default_types = (type(field.default), field.default_factory)
        if field.name not in of_any_type and type(value) not in default_types:
            _check_type(type(settings), field.name, value)
    names_by_rule = {
        "positive": positive,
        "finite": finite,
        "not_negative": not_negative,
        "at_least_one": at_least_one,
        "above_one": above_one,
        "relaxation": relaxation,
    }
    for rule, names in names_by_rule.items():
        words, holds = _RULES[rule]
        for name in names:
            value = getattr(settings, name)
            if value is not None and not holds(value):
                raise SettingError(f"{name} must {words}, got {value}")


def _check_type(settings: type, name: str, value: object) -> None:
    """Raise a SettingError unless a value has the annotated type.

    Arrays and protocols are not checked. Reading annotations is slow, 0.1 ms and more, so that this
    is not called for a value of the default's type.
    """
    annotation = typing.get_type_hints(settings)[name]
    types = typing.get_args(annotation) or (annotation,)
    if not all(map(_is_plain_class, types)):
        return
    if isinstance(value, tuple(_NUMBERS.get(kind, kind) for kind in types)):
        return
    members: list[str] = []
    type_names: list[str] = []
    for kind in types:
        if issubclass(kind, Enum):
            members += map(str, kind)
        else:
            type_names.append(kind.__name__.removesuffix("Type"))
    raise SettingError(f"{name} must be {' or '.join(members + type_names)}, got {value!r:.60}")


def _is_plain_class(annotated: object) -> bool:
    """Whether `isinstance` can tell its objects."""
    return isinstance(annotated, type) and not getattr(annotated, "_is_protocol", False)


# What linear algebra raises where numbers are beyond it, and what is raised here. Errors in a
# program, as a TypeError, are not among them. A step that can only improve an answer may end so.
FAILURES = (PGOError, ArithmeticError, LookupError, ValueError, RuntimeError, MemoryError)
