"""Names of orders and records, by which messages between machines and checkpoints refer to them.

A name is written where the order or record is defined. It stays when that is renamed or moves to
another file. Whoever has the same `VERSION` has the same names, with the same arguments and fields:
the version goes up with every change of these.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from pgo_models.certificates.certificate import BoundSource, Certificate, Verdict
from pgo_models.certificates.fit import Fit
from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.certificates.lower_bound import LowerBound
from pgo_models.certificates.rounding_errors import ObjectiveRounding
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.g2o_folder import Rows
from pgo_models.graphs.partitioning import Partition, PartitionMethod
from pgo_models.graphs.written_digits import WrittenDigits
from pgo_models.problem.weighting import Weighting
from pgo_models.relaxations.low_rank import LiftedPoses

VERSION = 10
K = TypeVar("K", bound=type)
F = TypeVar("F", bound=Callable[..., Any])
# Records of a package that knows nothing of messages.
_records: dict[str, type] = {
    "BoundSource": BoundSource,
    "Certificate": Certificate,
    "Fit": Fit,
    "HandednessTerms": HandednessTerms,
    "LiftedPoses": LiftedPoses,
    "LowerBound": LowerBound,
    "ObjectiveRounding": ObjectiveRounding,
    "Partition": Partition,
    "PartitionMethod": PartitionMethod,
    "Poses": Poses,
    "Rows": Rows,
    "Verdict": Verdict,
    "Weighting": Weighting,
    "WrittenDigits": WrittenDigits,
}
_name_of_record: dict[type, str] = {kind: name for name, kind in _records.items()}
_orders: dict[str, Callable[..., Any]] = {}
_name_of_order: dict[Callable[..., Any], str] = {}


def record(name: str) -> Callable[[K], K]:
    """Give a dataclass, a named tuple or an enum the name by which it is sent and written."""

    def register(kind: K) -> K:
        assert name not in _records, f"two records are called {name}"
        _records[name] = kind
        _name_of_record[kind] = name
        return kind

    return register


def order(name: str) -> Callable[[F], F]:
    """Give an order, a function of a worker and a request, the name by which it is sent."""

    def register(function: F) -> F:
        assert name not in _orders, f"two orders are called {name}"
        _orders[name] = function
        _name_of_order[function] = name
        return function

    return register


def name_of_record(kind: type) -> str:
    """Name of a record; a TypeError for a class that is none."""
    if kind not in _name_of_record:
        raise TypeError(f"{kind.__name__} is no record with a name")
    return _name_of_record[kind]


def record_named(name: str) -> type:
    """Record of this name; a ValueError if there is none."""
    if name not in _records:
        raise ValueError(f"{name!r:.80} is no record")
    return _records[name]


def name_of_order(function: Callable[..., Any]) -> str:
    """Name of an order; a TypeError for a function that is none."""
    if function not in _name_of_order:
        raise TypeError(f"{function.__qualname__} is no order with a name")
    return _name_of_order[function]


def order_named(name: str) -> Callable[..., Any]:
    """Order of this name; a ValueError if there is none."""
    if name not in _orders:
        raise ValueError(f"{name!r:.80} is no order")
    return _orders[name]


def names_and_fields() -> dict[str, tuple[str, ...]]:
    """What `VERSION` stands for: all orders, and all records with their fields or members."""
    described: dict[str, tuple[str, ...]] = dict.fromkeys(_orders, ())
    for name, kind in _records.items():
        members: Any = getattr(kind, "__members__", None)
        members = members or getattr(kind, "_fields", None) or kind.__dataclass_fields__  # type: ignore[attr-defined]
        described[f"record {name}"] = tuple(members)
    return described
