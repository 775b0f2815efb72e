"""What the options of `pgo` stand for: methods, starts, partitions and scenes by name."""

import enum
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.grid_worlds import grid_world
from pgo_models.graphs.partitioning import Partition, PartitionMethod, partition, suited_partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.scenes import (
    MILD_NOISE,
    NoiseModel,
    circle,
    grid,
    random_geometric,
    sphere,
    victoria_park,
)
from pgo_models.memory import check_memory
from pgo_models.problem.initialization import chordal_start, odometry_start, spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from solvers.distributed.driver import DEFAULT_MEMORY
from solvers.network.engine import Engine, InProcess
from solvers.network.ray_engine import RayEngine
from solvers.pipeline import WARM_START, Pipeline
from solvers.riemannian.newton import gauss_newton
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC
from solvers.robust.losses import RobustLoss
from solvers.soc.paper import PaperSOC
from solvers.soc.r_step import RStep
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC

# Words that options take; their values are the names in lower case, unless given.

# The first stage of a solve.
FirstStage = enum.StrEnum("FirstStage", "JOINT SUBSTRUCTURED CONSENSUS PAPER NEWTON")
Start = enum.StrEnum("Start", "CHORDAL TREE ODOMETRY FILE")
# Back ends of the R-step.
BackEndName = enum.StrEnum("BackEndName", "FACTORIZED FISTA CLARABEL")
# How poses go to robots.
Split = enum.StrEnum("Split", "GIVEN CONTIGUOUS METIS SINGLETONS")
# Where robots run.
Runner = enum.StrEnum("Runner", "PROCESS THREADS RAY")
# How wrong edges are found.
Robust = enum.StrEnum("Robust", {"GNC": "gnc", "GM": "gm", "PCM": "pcm", "PCM_GNC": "pcm-gnc"})
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

# Methods that driver and robots run.
ON_ROBOTS = (FirstStage.SUBSTRUCTURED, FirstStage.CONSENSUS, FirstStage.NEWTON)
# Arguments of `pgo solve` that go with robots which load their own files.
FOR_OWN_FILES = {
    "graph",
    "out",
    "method",
    "engine",
    "address",
    "driver_memory",
    "gap",
    "max_iterations",
    "tolerance",
    "time_limit",
    "threads",
    "verbose",
    "quiet",
}
ROBUST: dict[Robust, GNC | PCM] = {
    Robust.GNC: GNC(),
    Robust.GM: GNC(loss=RobustLoss.GEMAN_MCCLURE),
    Robust.PCM: PCM(),
    Robust.PCM_GNC: GNC(consistent=True),
}
_PAPER_SCENES = {Scene.CIRCLE: circle, Scene.GRID: grid, Scene.SPHERE: sphere}


class Cost(enum.Enum):
    """The cost that a command minimises or judges by."""

    CHI2 = "chi2"
    ISOTROPIC = "isotropic"
    UNIT = "unit"


def _finite_gap(gap: float) -> float:
    if not 0 < gap < math.inf:
        raise typer.BadParameter(f"{gap} is no positive, finite number; 1e-6 is usual")
    return gap


GraphArgument = Annotated[
    str,
    typer.Argument(
        help="A g2o file, a folder with one file a robot, or the name of a data set (see pgo info)."
    ),
]
SplitOption = Annotated[
    Split | None,
    typer.Option(
        help="How poses go to robots: as in the file, else with few cut edges (METIS), else "
        "contiguous."
    ),
]
RotationsOption = Annotated[
    bool,
    typer.Option(
        "--rotations",
        help="Estimate and certify rotations alone (rotation averaging): the cost is the rotation "
        "part of F. A file whose edges have only rotations needs no such option.",
    ),
]
CostOption = Annotated[
    Cost | None,
    typer.Option(
        help="chi2: of the file's information matrices, the default where it has them; isotropic: "
        "F, two precisions an edge, as in SE-Sync; unit: F with the weights of the paper."
    ),
]
InformationOption = Annotated[
    bool, typer.Option("--information", help="The same as --cost chi2.", hidden=True)
]
DropCouplingOption = Annotated[
    bool,
    typer.Option(
        "--drop-coupling",
        help="Solve for chi2 without the coupling blocks that make matrices indefinite, and say of "
        "how many edges; without this option the cost of such a file is F.",
    ),
]
SkipUnknownOption = Annotated[
    bool,
    typer.Option(
        "--skip-unknown", help="Skip lines of a g2o file with unknown tags, and say which."
    ),
]
ProofOption = Annotated[
    Path | None,
    typer.Option(
        help="Write the proof of the lower bound as JSON, for pgo verify; it is of the file that "
        "was solved, or of the one that --out writes where edges were left out."
    ),
]
GapOption = Annotated[float, typer.Option(callback=_finite_gap, help="Relative gap to certify.")]


def chosen_pipeline(
    method: FirstStage,
    robots: Partition | None,
    r_step: BackEndName | None,
    gap: float,
    max_iterations: int | None,
    tolerance: float | None,
    driver_memory: float | None = None,
) -> Pipeline:
    """Pipeline of the options of `pgo solve`.

    The `robots` are those of CONSENSUS and PAPER; `driver_memory` is in GB. A SettingError when the
    options do not go together.
    """
    if driver_memory is not None and method not in ON_ROBOTS:
        raise SettingError(
            f"--driver-memory is for methods that run on robots, got --method {method.value}"
        )
    memory = DEFAULT_MEMORY if driver_memory is None else 1e9 * driver_memory
    if method is FirstStage.NEWTON:
        _check_without_soc(r_step, max_iterations, tolerance)
        return Pipeline(soc=None, gap=gap, driver_memory=memory)
    if method is FirstStage.SUBSTRUCTURED and r_step not in (None, BackEndName.FACTORIZED):
        raise SettingError(
            f"--method substructured factors, got --r-step {r_step.value}; "
            "use joint, consensus or paper"
        )
    soc = _default_soc(method, has_driver=memory > 0)
    soc = replace(
        soc,
        robots=robots if method in (FirstStage.CONSENSUS, FirstStage.PAPER) else None,
        r_step=RStep.FACTORIZED if r_step is None else RStep[r_step.name],
        tolerance=soc.tolerance if tolerance is None else tolerance,
        max_iterations=soc.max_iterations if max_iterations is None else max_iterations,
    )
    if isinstance(soc, PaperSOC):
        return Pipeline(soc=soc, newton=gauss_newton(), gap=gap, driver_memory=memory)
    coupling = None if method is FirstStage.JOINT else Coupling[method.name]
    return Pipeline(soc=replace(soc, coupling=coupling), gap=gap, driver_memory=memory)


def _check_without_soc(
    r_step: BackEndName | None, max_iterations: int | None, tolerance: float | None
) -> None:
    """Raise a SettingError for an option of SOC, where the solve has none."""
    options_of_soc = {
        "--r-step": r_step,
        "--max-iterations": max_iterations,
        "--tolerance": tolerance,
    }
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


def chosen_partition(graph: PoseGraph, number: int | None, split: Split | None) -> Partition:
    """Partition of the options, by default among as many robots as the file names.

    Errors are those of `partition`, and a SettingError for a number that a split excludes.
    """
    if split is Split.SINGLETONS and number not in (None, graph.num_poses):
        raise SettingError(
            f"--split singletons makes {graph.num_poses} robots, got --robots {number}; "
            "leave one out"
        )
    number = graph.num_robots if number is None else number
    if split is None:
        return suited_partition(graph, number)
    return partition(graph, number, PartitionMethod[split.name])


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

    A SettingError when noise is out of its range, or for an option that is part of the scene: all
    of them in the paper's scenes, the number of robots in `random`.
    """
    _check_scene_options(
        scene,
        {
            "--robots": robots,
            "--poses": poses,
            "--dimension": d,
            "--translation-noise": translation_noise,
            "--rotation-noise": rotation_noise,
        },
    )
    if scene in _PAPER_SCENES:
        return _PAPER_SCENES[scene](rng)
    # Checked here, in degrees: an error of the scene would speak of radians.
    if rotation_noise is not None and not 0 < rotation_noise < math.inf:
        raise SettingError(f"--rotation-noise must be positive and finite, got {rotation_noise}")
    if poses is None:
        poses = 300 if scene is Scene.VICTORIA_PARK else 100
    if robots is None:
        robots = 4 if scene is Scene.GRID_WORLD else 1
    d = 3 if d is None else d
    num_poses = poses * robots
    memory = memory_of_scene(scene, num_poses, d)
    check_memory(memory, f"a scene of {num_poses} poses", "ask for fewer")
    noise = _chosen_noise(translation_noise, rotation_noise)
    if scene is Scene.VICTORIA_PARK:
        return victoria_park(rng, num_poses=poses, noise=noise)
    if scene is Scene.RANDOM:
        return random_geometric(poses, rng, d=d, noise=noise)
    return grid_world(robots, poses, rng, d=d, noise=noise)


def _check_scene_options(scene: Scene, options: dict[str, float | None]) -> None:
    """Raise a SettingError for an option that was given and is part of the scene."""
    fixed: tuple[str, ...] = ("--robots",)
    if scene is Scene.GRID_WORLD:
        fixed = ()
    elif scene is Scene.VICTORIA_PARK:
        fixed = ("--robots", "--dimension")
    elif scene in _PAPER_SCENES:
        fixed = tuple(options)
    for name in fixed:
        if options[name] is not None:
            raise SettingError(
                f"{name} does nothing for {scene.value}, of which it is a part; leave it out"
            )


def _chosen_noise(translation_noise: float | None, rotation_noise: float | None) -> NoiseModel:
    """Noise model of standard deviations in metres and degrees, mild unless given."""
    translation_std = MILD_NOISE.translation_std
    rotation_std = MILD_NOISE.rotation_std
    if translation_noise is not None:
        translation_std = translation_noise
    if rotation_noise is not None:
        rotation_std = float(np.deg2rad(rotation_noise))
    return NoiseModel(translation_std, rotation_std)


def memory_of_scene(scene: Scene, num_poses: int, d: int) -> float:
    """Bytes that a scene takes while it is made and written, beside those of the program.

    As measured at 20,000 and 100,000 poses. In the park every tree is compared with every pose.
    """
    per_pose = 4000.0 if d == 3 else 2000.0
    memory = per_pose * num_poses
    if scene is Scene.VICTORIA_PARK:
        memory += 12.0 * num_poses**2
    return memory
