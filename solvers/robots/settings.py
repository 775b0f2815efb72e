"""Robots that solve together, as `solve`, `extend` and `solve_folder` are given them.

A solve by robots may be broken off and go on later, from the file of a `Checkpoint`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.arrays import whole_number
from pgo_models.graphs.partitioning import Partition
from solvers.carry.faults import Faults
from solvers.carry.process import DEFAULT_MEMORY, Engine


@dataclass(frozen=True)
class Checkpoint:
    """Where and how often a solve by robots writes what it needs to go on.

    If the file exists when a solve begins, the solve goes on from it. The file is removed when the
    solve has converged, and stays when the solve was stopped, interrupted or out of time. Where a
    checkpoint cannot be written, say on a full disk, there is one warning, and the last one that
    could be written stays. Two runs of the same solve may use one file: every file is a whole
    checkpoint, from which either goes on.

    Parameters
    ----------
    path : Path or str
        The file.
    rounds : int
        Rounds of communication after which one is written; at least 1. There is also one when SOC
        and when Newton begins.

    Examples
    --------
    >>> import tempfile
    >>> from pgo_models import load
    >>> from solvers import Robots, solve
    >>> path = Path(tempfile.mkdtemp()) / "solve.checkpoint"
    >>> robots = Robots(2, checkpoint=Checkpoint(path))
    >>> stopped = solve(load("grid"), robots=robots, callback=lambda *_: True)
    >>> stopped.status.name, path.exists()
    ('STOPPED', True)
    >>> solution = solve(load("grid"), robots=robots)
    >>> solution.status.name, path.exists()
    ('CONVERGED', False)
    """

    path: Path | str
    rounds: int = 10

    def __post_init__(self) -> None:
        check_settings(self, at_least_one=["rounds"])


@dataclass(frozen=True)
class Robots:
    """Robots that share a solve: who owns which poses, where they run, and what goes wrong.

    Parameters
    ----------
    owners : Partition or int, optional
        Owners of the poses. A number stands for the partition of the pipeline's SOC, if that has as
        many robots, and else for the default one. `extend` takes those of the solution unless they
        are given, and `solve_folder` those of the files.
    engine : Engine, optional
        Where the robots run; in this process unless given.
    driver_memory : float
        Bytes that the driver may take with its matrix and factor. A solve that needs more is
        refused before it begins. 0 stands for no driver: CONSENSUS alone
        (`solvers.robots.place_without_driver`), which finds poses and no certificate.
    faults : Faults, optional
        What goes wrong between the robots of a CONSENSUS stage, which then does not wait
        (`solvers.robots.consensus`).
    checkpoint : Checkpoint, optional
        File to which the solve writes what it needs to go on after it was broken off, and from
        which it goes on.

    Examples
    --------
    >>> from pgo_models import load
    >>> from solvers import InProcess, solve
    >>> robots = Robots(3, engine=InProcess(threads=2))
    >>> solve(load("grid"), robots=robots).robots.num_robots
    3
    """

    owners: Partition | int | None = None
    engine: Engine | None = None
    driver_memory: float = DEFAULT_MEMORY
    faults: Faults | None = None
    checkpoint: Checkpoint | None = None

    def __post_init__(self) -> None:
        check_settings(self, not_negative=["driver_memory"])

    @classmethod
    def of(cls, robots: Robots | Partition | int) -> Robots:
        """Robots as they are given to `solve`, where owners alone will do."""
        if isinstance(robots, Robots):
            return robots
        if isinstance(robots, Partition):
            return cls(robots)
        return cls(whole_number(robots, "robots", SettingError))

    @property
    def partition(self) -> Partition:
        """Owners of the poses, once they are known one by one."""
        assert isinstance(self.owners, Partition)
        return self.owners

    @property
    def has_driver(self) -> bool:
        """Whether they have a driver."""
        return self.driver_memory > 0
