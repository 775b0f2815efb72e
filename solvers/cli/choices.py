"""What the options of `pgo solve` stand for: pipelines, methods, engines and starts."""

import os
from dataclasses import replace
from typing import TYPE_CHECKING

from pgo_models.certificates.certificate import DEFAULT_GAP
from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.initialization import chordal_start, odometry_start, spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from solvers.carry.process import DEFAULT_MEMORY, Engine, InProcess
from solvers.cli.options import FirstStage, Robust, Runner, Start, TakenForRight
from solvers.request import Pipeline
from solvers.riemannian.newton import gauss_newton
from solvers.soc.paper import PaperSOC
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC, WARM_START

if TYPE_CHECKING:
    from solvers.robust.consistency import PCM
    from solvers.robust.gnc import GNC

# Methods that driver and robots run.
ON_ROBOTS = (
    FirstStage.SUBSTRUCTURED,
    FirstStage.CONSENSUS,
    FirstStage.PAPER,
    FirstStage.NEWTON,
)
# Arguments of `pgo solve` that go with robots which load their own files.
FOR_OWN_FILES = {
    "graph",
    "out",
    "method",
    "robust",
    "known",
    "engine",
    "address",
    "driver_memory",
    "cost",
    "gap",
    "max_iterations",
    "tolerance",
    "time_limit",
    "trust_folder",
    "verbose",
    "quiet",
}


def chosen_pipeline(
    method: FirstStage,
    robots: Partition | None,
    gap: float,
    max_iterations: int | None,
    tolerance: float | None,
    has_driver: bool = True,
    is_asked_for: bool = True,
) -> Pipeline:
    """Pipeline of the options of `pgo solve`.

    The `robots` are those of CONSENSUS and PAPER. Where the method was
    not asked for, and no option is about SOC, the place of the solve chooses whether it runs SOC. A
    SettingError when the options do not go together.
    """
    if method is FirstStage.NEWTON:
        _check_without_soc(max_iterations, tolerance)
        return Pipeline(soc=None, gap=gap)
    if not is_asked_for and max_iterations is None and tolerance is None:
        return Pipeline(gap=gap)
    soc = _default_soc(method, has_driver)
    soc = replace(
        soc,
        robots=robots if method in (FirstStage.CONSENSUS, FirstStage.PAPER) else None,
        tolerance=soc.tolerance if tolerance is None else tolerance,
        max_iterations=soc.max_iterations if max_iterations is None else max_iterations,
    )
    if isinstance(soc, PaperSOC):
        return Pipeline(soc=soc, newton=gauss_newton(), gap=gap)
    if method is FirstStage.CONSENSUS:
        soc = replace(soc, coupling=Coupling.CONSENSUS)
    return Pipeline(soc=soc, gap=gap)


def pipeline_of_robots(method: FirstStage) -> Pipeline:
    """Pipeline of robots with files of their own, with one of the methods `ON_ROBOTS`."""
    return chosen_pipeline(method, None, DEFAULT_GAP, None, None)


def chosen_memory(method: FirstStage, driver_memory: float | None) -> float:
    """Bytes of the driver, from --driver-memory in GB; a SettingError for a method without one."""
    if driver_memory is None:
        return DEFAULT_MEMORY
    if method not in ON_ROBOTS:
        raise SettingError(
            f"--driver-memory is for methods that run on robots, got --method {method.value}"
        )
    return 1e9 * driver_memory


def _check_without_soc(max_iterations: int | None, tolerance: float | None) -> None:
    """Raise a SettingError for an option of SOC, where the solve has none."""
    options_of_soc = {"--max-iterations": max_iterations, "--tolerance": tolerance}
    for name, value in options_of_soc.items():
        if value is not None:
            raise SettingError(
                f"{name} is for SOC, which --method newton leaves out; leave out one of the two"
            )


def _default_soc(method: FirstStage, has_driver: bool) -> SOC | PaperSOC:
    """SOC of a method as it is unless options say something else.

    Without a driver no Newton takes over, so that SOC goes to its own tolerance.
    """
    if method is FirstStage.PAPER:
        return PaperSOC()
    return WARM_START if has_driver else SOC()


def chosen_method(method: FirstStage | None, robots: int | None, is_shared: bool) -> FirstStage:
    """Method of a solve: the one asked for, else JOINT, or SUBSTRUCTURED for several robots.

    `is_shared` says whether any option is about robots.
    """
    if method is FirstStage.JOINT and robots is not None and robots > 1:
        raise SettingError(
            f"--method joint has one robot, got --robots {robots}; use substructured or consensus"
        )
    if method is not None:
        return method
    return FirstStage.SUBSTRUCTURED if is_shared else FirstStage.JOINT


def chosen_engine(
    method: FirstStage, engine: Runner | None, address: str | None, checkpoint: bool
) -> Engine | None:
    """Engine of the options, or None where the method runs in one place.

    A SettingError when the options do not go together.
    """
    if method not in ON_ROBOTS:
        options = {"--engine": engine, "--address": address, "--resume": checkpoint}
        asked = [name for name, value in options.items() if value]
        if asked:
            names = " or ".join(other.value for other in ON_ROBOTS)
            raise SettingError(
                f"{asked[0]} is for methods that run on robots, "
                f"got --method {method.value}; use {names}"
            )
        return None
    if address is not None and engine not in (None, Runner.RAY):
        raise SettingError(
            f"--address is that of a Ray cluster, got --engine {engine.value}; use --engine ray"
        )
    if engine is Runner.RAY or address is not None:
        from solvers.carry.ray_engine import RayEngine

        return RayEngine(address=address)
    num_threads = (os.cpu_count() or 1) if engine is Runner.THREADS else 1
    return InProcess(threads=num_threads)


def chosen_start(problem: PGOProblem, start: Start | None) -> Poses | None:
    """Poses of a start; None leaves it to the method."""
    graph = problem.graph
    if start is Start.CHORDAL:
        return chordal_start(problem)
    if start is Start.TREE:
        return spanning_tree_start(graph)
    if start is Start.ODOMETRY:
        return odometry_start(graph)
    if start is Start.FILE:
        if graph.initial is None:
            raise SettingError(
                f"{graph.name} has no VERTEX line for every pose; use --start chordal or tree"
            )
        return graph.initial
    return None


def chosen_robust(robust: Robust | None, known: TakenForRight | None = None) -> "GNC | PCM | None":
    """How wrong edges are found, of the options --robust and --known."""
    if robust is None:
        if known is not None:
            raise SettingError("--known is of a robust solve; add --robust gnc")
        return None
    from solvers.robust.consistency import PCM
    from solvers.robust.gnc import GNC
    from solvers.robust.known import Known
    from solvers.robust.losses import RobustLoss

    methods: dict[Robust, GNC | PCM] = {
        Robust.GNC: GNC(),
        Robust.GM: GNC(loss=RobustLoss.GEMAN_MCCLURE),
        Robust.PCM: PCM(),
        Robust.PCM_GNC: GNC(consistent=True),
    }
    method = methods[robust]
    return method if known is None else replace(method, known=Known[known.name])
