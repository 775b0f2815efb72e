"""What orders leave with a robot: its poses and cost, and the session of one algorithm.

An algorithm that eliminates a matrix begins a session, in place of the one before, so that a robot
holds one elimination at a time. What outlasts sessions is in `InteriorState`.
"""

from dataclasses import dataclass

from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from solvers.carry.registry import record
from solvers.robots.records import Reweigh, RobotAscent
from solvers.robots.system import System


@record("Session")
@dataclass(frozen=True, eq=False)
class Session:
    """What an algorithm leaves for its next order; each has what it needs beside it in a subclass.

    The session of an algorithm that tries poses has them as `trial`, which `accept` goes to.
    """

    system: System | None = None
    trial: Poses | None = None


@record("InteriorState")
@dataclass(frozen=True, eq=False)
class InteriorState:
    """What orders leave with a robot; the p poses are those of its part."""

    poses: Poses
    saved: Poses  # those that `restore_poses` returns to
    session: Session | None = None
    # whether the current cost is the one that is solved, not the one that SOC is run on
    is_final: bool = False
    weights: Array | None = None  # (k,): of its edges, in a robust solve
    reweighing: Reweigh | None = None  # how these weights came about
    has_sent_laplacian: bool = False  # whether the driver has the matrix of the translations
    terms: HandednessTerms | None = None  # of its edges, for proofs with them
    ascent: RobotAscent | None = None  # the search for such terms
