"""`pgo generate`: a scene with known truth, in a g2o file or a folder with one file a robot."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from pgo_models.errors import SettingError, printable
from pgo_models.graphs.g2o import MOST_SYMBOLS, symbol_ids, write_g2o, write_g2o_folder
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.trajectories import write_tum
from solvers.cli.options import Scene, chosen_scene
from solvers.cli.shell import JsonOption, QuietOption, figures_of_facts, save_then_show, wrapped


def generate_command(
    scene: Annotated[Scene, typer.Argument(help="Which scene; the first three are the paper's.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="A .g2o file, or a name without suffix: a folder with one file a robot.",
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
    """Generate a scene with known truth, written beside it as NAME.truth.tum."""
    if out.suffix.lower() not in ("", ".g2o"):
        raise SettingError(
            f"cannot write {out}: give a name that ends in .g2o, "
            "or a folder's name without a suffix"
        )
    rng = np.random.default_rng(seed)
    graph = chosen_scene(scene, rng, poses, robots, dimension, translation_noise, rotation_noise)
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
    assert graph.truth is not None
    write_tum(graph.truth, truth)
