"""`pgo generate`: a scene with known truth, in a g2o file or a folder with one file a robot."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from pgo_models.errors import SettingError, printable
from pgo_models.graphs.g2o import MOST_SYMBOLS, symbol_ids, write_g2o, write_g2o_folder
from pgo_models.graphs.grid_worlds import grid_world
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
from pgo_models.graphs.trajectories import write_tum
from solvers.cli.options import Scene
from solvers.cli.shell import (
    JsonOption,
    QuietOption,
    figures_of_facts,
    is_standard_output,
    print_g2o,
    save_then_show,
    wrapped,
)

_PAPER_SCENES = {Scene.CIRCLE: circle, Scene.GRID: grid, Scene.SPHERE: sphere}


def generate_command(
    scene: Annotated[Scene, typer.Argument(help="Which scene; the first three are the paper's.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="A .g2o file, - for standard output, or a name without suffix: a folder with one "
            "file a robot.",
        ),
    ],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random generator.")] = 0,
    poses: Annotated[
        int | None,
        typer.Option(
            min=2,
            help="Poses in all (random; victoria-park: 300) or a robot (grid-world); default 100.",
        ),
    ] = None,
    robots: Annotated[
        int | None, typer.Option(min=1, help="Robots (grid-world); 4 unless given.")
    ] = None,
    dimension: Annotated[
        int | None,
        typer.Option(
            "--dimension", "-d", min=2, max=3, help="Of space (random, grid-world); 3 unless given."
        ),
    ] = None,
    translation_noise: Annotated[
        float | None,
        typer.Option(help="Standard deviation, metres (random, grid-world, victoria-park)."),
    ] = None,
    rotation_noise: Annotated[
        float | None,
        typer.Option(help="Standard deviation, degrees (random, grid-world, victoria-park)."),
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run `pgo generate`."""
    if not is_standard_output(out) and out.suffix.lower() not in ("", ".g2o"):
        raise SettingError(
            f"cannot write {out}: give a name that ends in .g2o, "
            "or a folder's name without a suffix"
        )
    rng = np.random.default_rng(seed)
    graph = chosen_scene(scene, rng, poses, robots, dimension, translation_noise, rotation_noise)
    if is_standard_output(out):
        if as_json:
            raise SettingError("--json and --out - both print on standard output; leave out one")
        print_g2o(partial(write_g2o, graph))
        return
    truth = out.absolute().parent / f"{out.absolute().stem}.truth.tum"
    _write_scene(graph, out, truth)
    record = {**figures_of_facts(graph.facts()), "written": [str(out), str(truth)]}
    # A path stays on its line, to be copied.
    lines = [wrapped(repr(graph))]
    lines += [printable(f"written: {path}") for path in (out, truth)]
    text = "\n".join(lines)
    save_then_show([], lambda: typer.echo(text), (lambda: record) if as_json else None, quiet)


def _write_scene(graph: PoseGraph, out: Path, truth: Path) -> None:
    """Write the scene as a file, or as a folder where `out` has no suffix, and its truth."""
    if out.suffix:
        write_g2o(graph, out)
    elif graph.num_robots <= MOST_SYMBOLS:
        write_g2o_folder(replace(graph, ids=symbol_ids(graph.robots)), out)
    else:
        # Symbols have 52 letters. Poses of more robots are numbered, and the files alone say whose
        # they are.
        write_g2o_folder(graph, out)
    write_tum(graph.truth, truth)


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
