"""What the options of `pgo` stand for: methods, starts, partitions and scenes by name."""

import enum
import math
import os
from dataclasses import replace
from typing import Annotated

import numpy as np
import typer

from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.grid_worlds import grid_world
from pgo_models.graphs.partitioning import Partition, PartitionMethod, partition, suited_partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.scenes import MILD_NOISE, NoiseModel, circle, grid, random_geometric, sphere, victoria_park
from pgo_models.problem.initialization import chordal_start, odometry_start, spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from solvers.distributed.driver import DEFAULT_MEMORY
from solvers.network.engine import Engine, InProcess
from solvers.network.ray_engine import RayEngine
from solvers.pipeline import HANDOVER, Pipeline
from solvers.riemannian.newton import gauss_newton
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC, RobustLoss
from solvers.soc.paper import PaperSOC
from solvers.soc.r_step import RStep
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC

# Words that options take; their values are the names in lower case, unless given.
FirstStage = enum.StrEnum("FirstStage", "JOINT SUBSTRUCTURED CONSENSUS PAPER NEWTON")  # of a solve
Start = enum.StrEnum("Start", "CHORDAL TREE ODOMETRY FILE")
BackEndName = enum.StrEnum("BackEndName", "FACTORIZED FISTA CLARABEL")  # of the R-step
Split = enum.StrEnum("Split", "GIVEN CONTIGUOUS METIS SINGLETONS")  # how poses go to robots
Runner = enum.StrEnum("Runner", "PROCESS THREADS RAY")  # where robots run
Robust = enum.StrEnum("Robust", {"GNC": "gnc", "GM": "gm", "PCM": "pcm", "PCM_GNC": "pcm-gnc"})  # finds wrong edges
Scene = enum.StrEnum(
    "Scene",
    {
        "CIRCLE": "circle",
        "GRID": "grid",
        "SPHERE": "sphere",
        "RANDOM": "random",
        "GRID_WORLD": "grid-world",
        "VICTORIA_PARK": "victoria-park",
    },
)

ON_ROBOTS = (FirstStage.SUBSTRUCTURED, FirstStage.CONSENSUS, FirstStage.NEWTON)  # methods that driver and robots run
# What `pgo solve` can be told of robots that load their own files.
FOR_OWN_FILES = {"graph", "out", "method", "engine", "address", "driver_memory", "gap", "max_iterations", "tolerance"}
FOR_OWN_FILES |= {"time_limit", "threads", "verbose", "quiet"}
ROBUST: dict[Robust, GNC | PCM] = {
    Robust.GNC: GNC(),
    Robust.GM: GNC(loss=RobustLoss.GEMAN_MCCLURE),
    Robust.PCM: PCM(),
    Robust.PCM_GNC: GNC(consistent=True),
}


def _finite_gap(gap: float) -> float:
    if not 0 < gap < math.inf:
        raise typer.BadParameter(f"{gap} is no positive, finite number; 1e-6 is usual")
    return gap


GraphArgument = Annotated[
    str, typer.Argument(help="A g2o file, a folder with one file a robot, or the name of a data set (see pgo info).")
]
SplitOption = Annotated[
    Split | None,
    typer.Option(help="How poses go to robots: as in the file, else with few cut edges (METIS), else contiguous."),
]
InformationOption = Annotated[
    bool, typer.Option("--information", help="The cost is chi2 of the file's information matrices, not F.")
]
SkipUnknownOption = Annotated[
    bool, typer.Option("--skip-unknown", help="Skip lines of a g2o file with unknown tags, and say which.")
]
GapOption = Annotated[float, typer.Option(callback=_finite_gap, help="Relative gap to certify.")]


def chosen_pipeline(
    method: FirstStage,
    robots: Partition | None,  # for CONSENSUS and PAPER
    r_step: BackEndName | None,
    gap: float,
    max_iterations: int | None,
    tolerance: float | None,
    driver_memory: float | None = None,  # GB
) -> Pipeline:
    """Pipeline of the options of `pgo solve`, a SettingError when they do not go together."""
    if driver_memory is not None and method not in ON_ROBOTS:
        raise SettingError(f"--driver-memory is for methods that run on robots, got --method {method.value}")
    memory = DEFAULT_MEMORY if driver_memory is None else 1e9 * driver_memory
    if method is FirstStage.NEWTON:
        for name, value in {"--r-step": r_step, "--max-iterations": max_iterations, "--tolerance": tolerance}.items():
            if value is not None:
                raise SettingError(f"{name} is for SOC, which --method newton leaves out; leave out one of the two")
        return Pipeline(soc=None, gap=gap, driver_memory=memory)
    r_step = BackEndName.FACTORIZED if r_step is None else r_step
    if method is FirstStage.SUBSTRUCTURED and r_step is not BackEndName.FACTORIZED:
        way_out = "use joint, consensus or paper"
        raise SettingError(f"--method substructured factors, got --r-step {r_step.value}; {way_out}")
    usual = PaperSOC() if method is FirstStage.PAPER else HANDOVER if memory > 0 else SOC()
    chosen = replace(
        usual,
        robots=robots if method in (FirstStage.CONSENSUS, FirstStage.PAPER) else None,
        r_step=RStep[r_step.name],
        tolerance=usual.tolerance if tolerance is None else tolerance,
        max_iterations=usual.max_iterations if max_iterations is None else max_iterations,
    )
    if isinstance(chosen, SOC):
        coupling = None if method is FirstStage.JOINT else Coupling[method.name]
        return Pipeline(soc=replace(chosen, coupling=coupling), gap=gap, driver_memory=memory)
    return Pipeline(soc=chosen, newton=gauss_newton(), gap=gap, driver_memory=memory)


def chosen_method(method: FirstStage | None, robots: int | None, is_shared: bool) -> FirstStage:
    """Method of a solve: as asked for, or the one that suits one robot or, if another option is about robots, many."""
    if method is FirstStage.JOINT and (robots or 1) > 1:
        raise SettingError(f"--method joint has one robot, got --robots {robots}; use substructured or consensus")
    if method is None:
        return FirstStage.SUBSTRUCTURED if is_shared else FirstStage.JOINT
    return method


def chosen_partition(graph: PoseGraph, number: int | None, split: Split | None) -> Partition:
    """Partition of the options, by default among as many robots as the file names; errors are those of `partition`."""
    if split is Split.SINGLETONS and number not in (None, graph.num_poses):
        raise SettingError(f"--split singletons makes {graph.num_poses} robots, got --robots {number}; leave one out")
    number = graph.num_robots if number is None else number
    return suited_partition(graph, number) if split is None else partition(graph, number, PartitionMethod[split.name])


def chosen_engine(method: FirstStage, engine: Runner | None, address: str | None, checkpoint: bool) -> Engine | None:
    """Engine of the options, a SettingError when they do not go together; None where the method runs in one place."""
    asked = [name for name, given in (("--engine", engine), ("--address", address), ("--resume", checkpoint)) if given]
    if method not in ON_ROBOTS:
        if asked:
            names = " or ".join(one.value for one in ON_ROBOTS)
            what = f"{asked[0]} is for methods that run on robots"
            raise SettingError(f"{what}, got --method {method.value}; use {names}")
        return None
    if address is not None and engine not in (None, Runner.RAY):
        raise SettingError(f"--address is that of a Ray cluster, got --engine {engine.value}; use --engine ray")
    if engine is Runner.RAY or address is not None:
        return RayEngine(address=address)
    return InProcess(threads=(os.cpu_count() or 1) if engine is Runner.THREADS else 1)


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
            raise SettingError(f"{graph.name} has no VERTEX line for every pose; use --start chordal or tree")
        return graph.initial
    return None


def chosen_scene(
    scene: Scene,
    rng: np.random.Generator,
    poses: int | None,
    robots: int | None,
    d: int | None,
    translation_noise: float | None,
    rotation_noise: float | None,
) -> PoseGraph:
    """Scene with noise in metres and degrees.

    A SettingError when noise is out of its range, or something is given that is part of the scene: all of it in the
    paper's scenes, the number of robots in `random`.
    """
    paper = {Scene.CIRCLE: circle, Scene.GRID: grid, Scene.SPHERE: sphere}
    settled: dict[str, float | None] = {} if scene is Scene.GRID_WORLD else {"--robots": robots}
    if scene in paper:
        noises = {"--translation-noise": translation_noise, "--rotation-noise": rotation_noise}
        settled |= {"--poses": poses, "--dimension": d, **noises}
    if scene is Scene.VICTORIA_PARK:
        settled["--dimension"] = d
    for name, value in settled.items():
        if value is not None:
            raise SettingError(f"{name} does nothing for {scene.value}, of which it is a part; leave it out")
    if scene in paper:
        return paper[scene](rng)
    if rotation_noise is not None and not 0 < rotation_noise < math.inf:  # before it is turned into radians
        raise SettingError(f"--rotation-noise must be positive and finite, got {rotation_noise}")
    poses, d = poses if poses is not None else 300 if scene is Scene.VICTORIA_PARK else 100, d if d is not None else 3
    noise = NoiseModel(
        MILD_NOISE.translation_std if translation_noise is None else translation_noise,
        MILD_NOISE.rotation_std if rotation_noise is None else float(np.deg2rad(rotation_noise)),
    )
    if scene is Scene.VICTORIA_PARK:
        return victoria_park(rng, num_poses=poses, noise=noise)
    if scene is Scene.RANDOM:
        return random_geometric(poses, rng, d=d, noise=noise)
    return grid_world(robots if robots is not None else 4, poses, rng, d=d, noise=noise)
