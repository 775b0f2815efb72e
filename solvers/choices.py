"""What the options of `pgo` stand for: methods, starts, partitions and scenes by name."""

from __future__ import annotations

import enum

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.grid_world import grid_world
from pgo_models.initialization import chordal_start, odometry_start, spanning_tree_start
from pgo_models.partition import Partition, PartitionMethod, partition
from pgo_models.pose_graph import PoseGraph
from pgo_models.poses import Poses
from pgo_models.problem import PGOProblem
from pgo_models.scenes import MILD_NOISE, NoiseModel, circle, grid, random_geometric, sphere
from solvers.newton import Newton, gauss_newton
from solvers.pipeline import HANDOVER_TOLERANCE, Pipeline
from solvers.rotation_step import RStep
from solvers.soc import SOC, Coupling


class Method(enum.Enum):
    """First stage of a solve."""

    JOINT = "joint"
    CONSENSUS = "consensus"
    PAPER = "paper"
    NEWTON = "newton"


class Start(enum.Enum):
    """Where a solve starts."""

    CHORDAL = "chordal"
    TREE = "tree"
    ODOMETRY = "odometry"
    FILE = "file"


class BackEnd(enum.Enum):
    """Names of the R-step's back ends."""

    FACTORIZED = "factorized"
    FISTA = "fista"
    CLARABEL = "clarabel"


class Split(enum.Enum):
    """Names of the partitions."""

    GIVEN = "given"
    CONTIGUOUS = "contiguous"
    METIS = "metis"
    SINGLETONS = "singletons"


class Scene(enum.Enum):
    """Scenes that can be generated."""

    CIRCLE = "circle"
    GRID = "grid"
    SPHERE = "sphere"
    RANDOM = "random"
    GRID_WORLD = "grid-world"


def chosen_pipeline(
    problem: PGOProblem,
    method: Method | None,
    robots: int | None,
    split: Split | None,
    r_step: BackEnd,
    gap: float,
    max_iterations: int | None,
    tolerance: float | None,
) -> Pipeline:
    """Pipeline of the options of `pgo solve`.

    Raises
    ------
    SettingError
        When they do not go together.
    """
    if method is None:
        method = Method.JOINT if robots is None and split is None else Method.CONSENSUS
    if method is Method.NEWTON:
        return Pipeline(soc=None, gap=gap)
    if method is Method.JOINT and (robots or 1) > 1:
        raise SettingError(f"--method joint has one robot, got --robots {robots}; use consensus or paper")
    shared = None
    if method is not Method.JOINT:
        shared = _robots(problem, robots, split, problem.graph.num_robots if method is Method.CONSENSUS else None)
    handover = SOC.tolerance if method is Method.PAPER else HANDOVER_TOLERANCE
    soc = SOC(
        coupling=Coupling[method.name],
        robots=shared,
        r_step=RStep[r_step.name],
        tolerance=handover if tolerance is None else tolerance,
        max_iterations=SOC.max_iterations if max_iterations is None else max_iterations,
    )
    return Pipeline(soc=soc, newton=gauss_newton() if method is Method.PAPER else Newton(), gap=gap)


def _robots(problem: PGOProblem, robots: int | None, split: Split | None, default: int | None) -> Partition | None:
    if robots is None and split is None and default is None:
        return None
    number = robots if robots is not None else default
    return partition(problem.graph, number, None if split is None else PartitionMethod[split.name])


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
    poses: int,
    robots: int,
    d: int,
    translation_noise: float | None,
    rotation_noise: float | None,
) -> PoseGraph:
    """Scene with noise in metres and degrees.

    Raises
    ------
    SettingError
        When noise is given for one of the paper's scenes, whose noise is part of it, or is out of its range.
    """
    paper = {Scene.CIRCLE: circle, Scene.GRID: grid, Scene.SPHERE: sphere}
    if scene in paper:
        if translation_noise is not None or rotation_noise is not None:
            raise SettingError(f"the noise of {scene.value} is part of the scene; use random or grid-world for others")
        return paper[scene](rng)
    noise = NoiseModel(
        MILD_NOISE.translation_std if translation_noise is None else translation_noise,
        MILD_NOISE.rotation_std if rotation_noise is None else float(np.deg2rad(rotation_noise)),
    )
    if scene is Scene.RANDOM:
        return random_geometric(poses, rng, d=d, noise=noise)
    return grid_world(robots, poses, rng, d=d, noise=noise)
