"""What a value means where an annotation wants a type, for the checks at the doors.

What is clear is converted: a graph where a problem is wanted, the name of an enum's member in any
case, a seed for a generator, a list for an array. Anything else is answered with one sentence: what
must be given, what was, and a way out. A class says by `_from_given` what stands for its objects,
and by `_way_out` how to make one; without annotations, these are no fields of a dataclass.
"""

import builtins
import collections.abc
import functools
import operator
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from enum import Enum
from numbers import Integral, Real
from pathlib import Path
from typing import Any, cast

import numpy as np

_PACKAGES = ("pgo_models.", "solvers.")
_MAX_SHOWN = 60  # characters of what was given
# Kinds of arrays, as in `np.dtype.kind`, that are taken for a kind of numbers, and their words.
_ARRAYS: dict[type, tuple[str, str]] = {
    np.floating: ("fiu", "real numbers"),
    np.integer: ("iu", "whole numbers"),
    np.bool: ("b", "booleans"),
}
_WORDS: dict[object, str] = {
    float: "a number",
    int: "a whole number",
    bool: "True or False",
    str: "a string",
    Path: "a path",
    type(None): "None",
    np.random.Generator: "a seed or np.random.default_rng(..)",
    collections.abc.Callable: "a function",
    collections.abc.Mapping: "a dict",
}
_FUNCTIONS: tuple[object, ...] = (collections.abc.Callable,)
_SEQUENCES = (list, tuple, collections.abc.Sequence)


class MisfitError(TypeError):
    """A value that an annotation does not allow, and that is not converted."""


def fitted(owner: object, annotation: object, value: object) -> object:
    """`value` as an annotation wants it, converted where that is clear.

    The owner is the function or class whose module has the names of the annotation. Raises a
    MisfitError, which says what must be given.
    """
    hint = _resolved(owner, annotation)
    try:
        return _converted(value, hint)
    except MisfitError:
        raise MisfitError(_sentence(hint, value)) from None


# Annotations.


def _resolved(owner: object, annotation: object) -> object:
    """The type that an annotation names; what is imported for type checks alone is looked up."""
    if not isinstance(annotation, str):
        return annotation
    names = vars(sys.modules[str(owner.__module__)])
    return eval(_compiled(annotation), names, _LoadedClasses(names))


@functools.cache
def _compiled(annotation: str) -> types.CodeType:
    return compile(annotation, "<annotation>", "eval")


class _LoadedClasses(Mapping[str, object]):
    """Classes of this project that are imported by now, for names that a module does not have.

    A class that no module has imported has no objects either: an empty one stands for it.
    """

    def __init__(self, names: Mapping[str, object]) -> None:
        self._names = names

    def __getitem__(self, name: str) -> object:
        # No class has a name like those that a debugger or pytest asks a frame for.
        if name in self._names or hasattr(builtins, name) or name.startswith("__"):
            raise KeyError(name)
        for module_name, module in tuple(sys.modules.items()):
            if module_name.startswith(_PACKAGES) and isinstance(vars(module).get(name), type):
                return vars(module)[name]
        return type(name, (), {})

    def __iter__(self) -> Iterator[str]:
        return iter(())

    def __len__(self) -> int:
        return 0


@functools.cache
def _options(hint: object) -> tuple[object, ...]:
    """The types of a union, in which Any is `MaybeNone`; a type alone is its only option."""
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        return tuple(type(None) if option is Any else option for option in typing.get_args(hint))
    return (hint,)


@functools.cache
def _kind(option: object) -> type | None:
    """The class of a type, without its arguments; None where anything is allowed."""
    kind = typing.get_origin(option) or option
    return None if kind is Any or not isinstance(kind, type) else kind


# Values.


def _converted(value: object, hint: object) -> object:
    """The value itself where an option of the annotation has it, else what is clearly meant."""
    if type(value) is hint:
        return value
    options = _options(hint)
    if any(_fits(value, option) for option in options):
        return value
    for option in options:
        try:
            return _meant(value, option)
        except MisfitError:
            continue
    raise MisfitError


def _fits(value: object, option: object) -> bool:
    """Whether a value is of one type, without conversion."""
    kind = _kind(option)
    if kind is None:
        return True
    if kind in _FUNCTIONS:
        return callable(value) and not isinstance(value, type)
    if kind is np.ndarray:
        return isinstance(value, np.ndarray) and value.dtype.type is _number(option)
    if kind in _SEQUENCES:
        return False  # decided with their entries
    if kind is float or kind is int:
        # Numbers of NumPy are taken, True and False are not.
        number = Real if kind is float else Integral
        return isinstance(value, number) and not isinstance(value, bool)
    if kind is bool:
        return isinstance(value, bool | np.bool)
    if getattr(kind, "_is_protocol", False):
        return not isinstance(value, type) and _missing_member(value, kind) is None
    return isinstance(value, kind)


def _meant(value: object, option: object) -> object:
    """What a value clearly means where one type is wanted; raises a misfit where it is not."""
    kind = _kind(option)
    if kind is None:
        raise MisfitError
    if kind is np.ndarray:
        return _array(value, _number(option))
    if kind in _SEQUENCES:
        return _sequence(value, kind, typing.get_args(option))
    if issubclass(kind, Enum) and isinstance(value, str):
        name = value.strip().upper().replace("-", "_")
        if name in kind.__members__:
            return kind[name]
    if kind is np.random.Generator and _fits(value, int) and cast(int, value) >= 0:
        return np.random.default_rng(cast(int, value))
    if kind is Path and isinstance(value, str):
        return Path(value)
    from_given = getattr(kind, "_from_given", None)
    converted = from_given(value) if from_given is not None else None
    if converted is None:
        raise MisfitError
    return converted


@functools.cache
def _number(array: object) -> type[np.generic]:
    """Type of the numbers of an annotated array."""
    [number] = typing.get_args(typing.get_args(array)[1]) or (np.float64,)
    return cast("type[np.generic]", typing.get_origin(number) or number)


def _array(value: object, number: type[np.generic]) -> object:
    """Numbers in an array; raises a misfit for numbers of another kind, and for no numbers."""
    if not isinstance(value, np.ndarray | list | tuple):
        raise MisfitError
    try:
        array = np.asarray(value)
    except ValueError:  # rows of several lengths
        raise MisfitError from None
    kinds, _ = _kind_of(number)
    if array.dtype.kind not in kinds and array.size:
        raise MisfitError
    is_exact = issubclass(array.dtype.type, number)
    return array if is_exact else array.astype(np.int64 if number is np.integer else number)


def _kind_of(number: type[np.generic]) -> tuple[str, str]:
    return next(words for kind, words in _ARRAYS.items() if issubclass(number, kind))


def _sequence(value: object, kind: type, entries: tuple[object, ...]) -> object:
    """A list or a tuple whose entries fit: the one that is given, where that is so as it is."""
    if isinstance(value, str | Mapping) or not isinstance(value, collections.abc.Sequence):
        raise MisfitError
    repeated = kind is not tuple or Ellipsis in entries
    hints = entries[:1] * len(value) if repeated else entries
    if len(hints) != len(value) and entries:
        raise MisfitError
    converted = [_converted(entry, hint) for entry, hint in zip(value, hints, strict=bool(entries))]
    is_right = isinstance(value, tuple) if kind is tuple else isinstance(value, kind)
    if is_right and all(map(operator.is_, converted, value)):
        return value
    return tuple(converted) if kind is tuple else converted


def _missing_member(value: object, protocol: type) -> str | None:
    """A member of a protocol that an object lacks."""
    for owner in protocol.__mro__:
        if getattr(owner, "_is_protocol", False) and owner.__module__ != "typing":
            names = (*vars(owner), *vars(owner).get("__annotations__", ()))
            for name in map(str, names):
                if not name.startswith("_") and not hasattr(value, name):
                    return name
    return None


# Sentences.


def _sentence(hint: object, value: object) -> str:
    options = _options(hint)
    wanted = " or ".join(dict.fromkeys(map(_wanted, options)))
    ways_out = filter(None, (_way_out(value, option) for option in options))
    way_out = next((f"; {way_out}" for way_out in ways_out), "")
    return f"must be {wanted}, got {_shown(value)}{way_out}"


def _wanted(option: object) -> str:
    """Words for a type: "a whole number", "a PoseGraph", "a list of PoseGraph", .."""
    kind = _kind(option)
    if kind is None:
        return "anything"
    if kind is np.ndarray:
        return f"an array of {_kind_of(_number(option))[1]}"
    if kind in _SEQUENCES:
        return _wanted_list(kind, typing.get_args(option))
    if issubclass(kind, Enum):
        return " or ".join(map(str, kind))
    return _WORDS.get(kind, _with_article(kind.__name__))


def _wanted_list(kind: type, entries: tuple[object, ...]) -> str:
    if kind is tuple and entries and Ellipsis not in entries:
        return f"a tuple ({', '.join(map(_wanted, entries))})"
    if not entries or _kind(entries[0]) is None:
        return "a list"
    return f"a list, each {_wanted(entries[0])}"


def _with_article(name: str) -> str:
    if name.endswith("s"):
        return name
    return f"an {name}" if name[0] in "AEIO" else f"a {name}"


def _way_out(value: object, option: object) -> str:
    kind = _kind(option)
    if kind is None:
        return ""
    is_protocol = getattr(kind, "_is_protocol", False)
    if isinstance(value, type):
        is_class_of_it = is_protocol or issubclass(value, kind)
        return f"give an object, as {value.__name__}(..)" if is_class_of_it else ""
    if is_protocol:
        return f"it has no `{_missing_member(value, kind)}`"
    if issubclass(kind, Enum) and isinstance(value, str):
        return _suggestion(value, kind)
    return str(getattr(kind, "_way_out", ""))


def _suggestion(value: str, kind: type[Enum]) -> str:
    import difflib  # where something is wrong, alone

    close = difflib.get_close_matches(value.upper(), kind.__members__, n=1)
    return f"did you mean {kind[close[0]]}?" if close else ""


def _shown(value: object) -> str:
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} and type {value.dtype}"
    shown = " ".join(repr(value).split())
    return shown if len(shown) <= _MAX_SHOWN else f"{shown[:_MAX_SHOWN]}.."
