"""Names of orders and records, by which messages between machines and checkpoints refer to them.

A name is written where the order or record is defined. It stays when that is renamed or moves to
another file. Whoever has the same `VERSION` has the same names, with the same arguments and fields:
the version goes up with every change of these.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from pgo_models.certificates.axes import AxisTerms
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

VERSION = 35
T = TypeVar("T")


@dataclass(eq=False)
class _Names:
    """Names of orders, or of records, in both directions."""

    what: str
    known: dict[str, Any]
    name_of: dict[object, str] = field(init=False)

    def __post_init__(self) -> None:
        self.name_of = {named: name for name, named in self.known.items()}

    def given(self, name: str) -> Callable[[T], T]:
        """Give what is decorated the name by which it is sent and written."""

        def register(named: T) -> T:
            assert name not in self.known, f"two {self.what}s are called {name}"
            self.known[name] = named
            self.name_of[named] = name
            return named

        return register

    def name(self, named: Any) -> str:  # noqa: ANN401 - a class or a function
        """Name of a class or function; a TypeError if it has none."""
        if named not in self.name_of:
            raise TypeError(f"{named.__qualname__} is no {self.what} with a name")
        return self.name_of[named]

    def called(self, name: str) -> Any:  # noqa: ANN401 - a class or a function
        """What has this name; a ValueError if nothing has."""
        if name not in self.known:
            raise ValueError(f"{name!r:.80} is no {self.what}")
        return self.known[name]


_records = _Names(
    "record",
    {  # of a package that knows nothing of messages
        "AxisTerms": AxisTerms,
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
    },
)
_orders = _Names("order", {})
# Decorators of records (dataclasses, named tuples, enums), and of orders, functions of a worker and
# a request.
record = _records.given
order = _orders.given
name_of_record = _records.name
record_named = _records.called
name_of_order = _orders.name
order_named = _orders.called


def names_and_fields() -> dict[str, tuple[str, ...]]:
    """What `VERSION` stands for: all orders, and all records with their fields or members."""
    described: dict[str, tuple[str, ...]] = dict.fromkeys(_orders.known, ())
    for name, kind in _records.known.items():
        members = getattr(kind, "__members__", None) or getattr(kind, "_fields", None)
        described[f"record {name}"] = tuple(members or kind.__dataclass_fields__)
    return described
