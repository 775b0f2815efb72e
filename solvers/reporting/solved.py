"""What a report is of."""

from dataclasses import dataclass

from pgo_models.certificates.certificate import Certificate
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.problem import PGOProblem
from solvers.network.ledger import Ledger
from solvers.result import Stage, Status
from solvers.robust.rejection import Rejection


@dataclass(frozen=True, eq=False)
class Solved:
    """What a report is of: the fields of `solvers.solution.Solution`, which says what they are."""

    problem: PGOProblem
    poses: Poses
    objective: float
    certificate: Certificate
    status: Status
    stages: tuple[Stage, ...]
    seconds: float
    ledger: Ledger | None = None
    robots: Partition | None = None
    note: str = ""
    frame: str = ""
    anchor: int = 0
    covariances: Array | None = None
    robust: Rejection | None = None
