"""The errors of the project: one tree, each message with what was wrong, where, the value and the way out."""

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

_NUMBERS: dict[type, type] = {float: Real, int: Integral}  # numpy's, too


class PGOError(Exception):
    """Root of every error that a wrong input or a missing piece raises here."""


class GraphError(PGOError):
    """A pose graph, or poses, that cannot be what they claim to be."""


class GraphWarning(UserWarning):
    """Something in the files of a pose graph that was not taken as it stands."""


class SettingError(PGOError, ValueError):
    """A setting of a solver, a model or a scene that is out of its range: raised where the settings are made."""


class FileFormatError(PGOError):
    """A file that cannot be read; the message opens with `file:line`."""

    def __init__(self, path: Path | str, line: int | None, problem: str) -> None:
        """Say where (`path`, 1-based `line`) and what (`problem`, with the value and the way out)."""
        where = f"{path}" if line is None else f"{path}:{line}"
        super().__init__(f"{where}: {problem}")
        self.path, self.line, self._given = Path(path), line, (path, line, problem)

    def __reduce__(self) -> "tuple[type[FileFormatError], tuple[Path | str, int | None, str]]":
        return type(self), self._given


class DatasetError(PGOError):
    """A named data set that is nowhere to be found, or whose checksum does not fit."""


class NotPositiveDefiniteError(PGOError):
    """A matrix that should have a Cholesky factorisation has none."""


class ProofError(PGOError):
    """Poses that cost less than a bound that was proved: a defect here, never to be printed as a result."""


class EngineError(PGOError):
    """A place where robots run that cannot be reached, has no room for them, or loses them."""


class MissingExtraError(PGOError):
    """An optional dependency is not installed; the message names the extra.

    Whatever draws raises it without matplotlib or plotly, which the extra `plot` brings.
    """

    def __init__(self, package: str, extra: str) -> None:
        """Name the missing `package` and the `extra` that brings it."""
        super().__init__(f"{package} is not installed; run: pip install 'pgo-splitting[{extra}]'")
        self.extra, self._package = extra, package

    def __reduce__(self) -> "tuple[type[MissingExtraError], tuple[str, str]]":
        return type(self), (self._package, self.extra)


def extra_module(name: str, extra: str) -> ModuleType:
    """Module of a package that an extra brings, by its full name; a MissingExtraError where it is not installed."""
    package = name.partition(".")[0]
    try:
        importlib.import_module(package)
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingExtraError(package, extra) from error


def check_quantile(quantile: float) -> None:
    """Raise a SettingError unless a quantile is between 0 and 1."""
    if not 0.0 < quantile < 1.0:
        raise SettingError(f"quantile is {quantile!r}; give a probability between 0 and 1, such as 0.99")


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
    """Raise a SettingError for the first field of another type, or of those named out of its range unless None."""
    for field in dataclasses.fields(cast(Any, settings)):
        value = getattr(settings, field.name)
        if field.name not in of_any_type and type(value) not in (type(field.default), field.default_factory):
            _check_type(type(settings), field.name, value)
    rules: tuple[tuple[Sequence[str], str, Callable[[float], bool]], ...] = (
        (positive, "be positive", lambda value: value > 0),
        (finite, "be positive and finite", lambda value: 0 < value < math.inf),
        (not_negative, "not be negative", lambda value: value >= 0),
        (at_least_one, "be at least 1", lambda value: value >= 1),
        (above_one, "be above 1", lambda value: value > 1),
        (relaxation, "be in (0, 2)", lambda value: 0 < value < 2),
    )
    for names, rule, holds in rules:
        for name in names:
            value = getattr(settings, name)
            if value is not None and not holds(value):
                raise SettingError(f"{name} must {rule}, got {value}")


def _check_type(settings: type, name: str, value: object) -> None:
    """Raise a SettingError unless a value has the annotated type, where that can be told: of arrays and protocols not.

    Annotations are slow to read, 0.1 ms and more: not for a value of the default's type.
    """
    annotated = typing.get_type_hints(settings)[name]
    kinds = typing.get_args(annotated) or (annotated,)
    if not all(isinstance(kind, type) and not getattr(kind, "_is_protocol", False) for kind in kinds):
        return
    if not isinstance(value, tuple(_NUMBERS.get(kind, kind) for kind in kinds)):
        choices = [str(one) for kind in kinds if issubclass(kind, Enum) for one in kind]
        choices += [kind.__name__.removesuffix("Type") for kind in kinds if not issubclass(kind, Enum)]
        raise SettingError(f"{name} must be {' or '.join(choices)}, got {value!r:.60}")
