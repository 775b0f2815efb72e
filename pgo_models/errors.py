"""The errors of the project, and checks of settings that raise them.

Each message says what was wrong, where, the value and the way out.
"""

import dataclasses
import functools
import importlib
import inspect
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])

# How loaders of shared libraries say that memory ran out.
_OUT_OF_MEMORY = ("failed to map segment", "cannot allocate memory", "out of memory")

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

    A MissingExtraError where it is not installed.
    """
    package = name.partition(".")[0]
    try:
        importlib.import_module(package)
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingExtraError(package, extra) from error


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
    the annotations; what is clearly meant is converted, as at the doors (`pgo_models.doors`).
    """
    for field in dataclasses.fields(cast(Any, settings)):
        if not field.init:
            continue
        value = getattr(settings, field.name)
        default_types = (type(field.default), field.default_factory)
        if field.name not in of_any_type and type(value) not in default_types:
            _check_field(settings, field, value)
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


def door(function: F) -> F:
    """Check and convert what a public function is given, by its annotations.

    Defaults are not checked. A SettingError names the function and the argument.
    """

    @functools.wraps(function)
    def checked(*arguments: object, **named: object) -> object:
        place = f"{function.__qualname__}: "
        values = fitted_arguments(function, arguments, place)
        parameters = _parameters_of(function)
        for name, value in named.items():
            if name in parameters:
                named[name] = _argument(function, parameters[name], value, place)
        return function(*values, **named)

    return cast(F, checked)


def fitted_arguments(
    function: Callable[..., Any], arguments: Sequence[object], place: str
) -> list[Any]:
    """Positional arguments of a function, checked and converted by its annotations.

    A SettingError begins with the place.
    """
    pairs = zip(_parameters_of(function).values(), arguments, strict=False)
    values = [_argument(function, parameter, value, place) for parameter, value in pairs]
    return [*values, *arguments[len(values) :]]  # of too many Python says so


@functools.cache
def _parameters_of(function: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    return dict(inspect.signature(function).parameters)


def _argument(
    function: Callable[..., Any], parameter: inspect.Parameter, value: object, place: str
) -> object:
    annotation = parameter.annotation
    if value is parameter.default or annotation is parameter.empty or type(value) is annotation:
        return value
    return _fitted(function, annotation, f"{place}{parameter.name}", value)


def _check_field(settings: object, field: dataclasses.Field[Any], value: object) -> None:
    """Raise a SettingError unless the value of a field has the annotated type, or means one.

    Reading annotations is slow, so that this is not called for a value of the default's type.
    """
    owners = type(settings).__mro__
    owner = next(kind for kind in owners if field.name in vars(kind).get("__annotations__", ()))
    converted = _fitted(owner, field.type, field.name, value)
    if converted is not value:
        object.__setattr__(settings, field.name, converted)


def _fitted(owner: object, annotation: object, name: str, value: object) -> object:
    from pgo_models.annotations import MisfitError, fitted  # imports numpy

    try:
        return fitted(owner, annotation, value)
    except MisfitError as error:
        raise SettingError(f"{name} {error}") from None


# What linear algebra raises where numbers are beyond it, and what is raised here. Errors in a
# program, as a TypeError, are not among them. A step that can only improve an answer may end so.
FAILURES = (PGOError, ArithmeticError, LookupError, ValueError, RuntimeError, MemoryError)
