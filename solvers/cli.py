"""The command `pgo`: solve, certify, info, generate, and the studies of `solvers.studies.commands`.

Exit codes: 0 done; 1 bad input, one line on stderr; 2 not converged, the result written all the same; 3 not certified;
130 and 143 after SIGINT (Ctrl-C) and SIGTERM, the best iterate written if there was one.
"""

import json
import math
import re
import shlex
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from pgo_models.certificates.certificate import DEFAULT_GAP, Certificate, certify
from pgo_models.errors import NotPositiveDefiniteError, SettingError
from pgo_models.files import check_writable
from pgo_models.geometry.poses import absolute_trajectory_error
from pgo_models.graphs.datasets import known_datasets, locate
from pgo_models.graphs.g2o import MOST_SYMBOLS, symbol_ids, write_g2o, write_g2o_folder
from pgo_models.graphs.separators import report_partition
from pgo_models.graphs.trajectories import write_tum
from pgo_models.problem.marginals import write_covariances
from solvers import cli_options as choices
from solvers.cli_inputs import estimated_poses, load_graph, pose_named, pose_problem, with_times
from solvers.cli_options import GapOption, GraphArgument, InformationOption, SkipUnknownOption, SplitOption
from solvers.distributed.checkpoint import Checkpoint
from solvers.explanations import explained_by_its_graph, hint_of_chi2, hint_of_misfits, warn_of_weights, with_places
from solvers.folder_solve import solve_folder
from solvers.pipeline import HANDOVER, solve
from solvers.progress_bars import JobBar
from solvers.reporting.graph_facts import describe_graph, memory_note
from solvers.reporting.report import check_report, write_report
from solvers.reporting.versions import installation, installed_version, installed_versions
from solvers.result import Status
from solvers.shell import DONE, Commands, JsonOption, QuietOption, ThreadsOption, run_command, save_then_show, wrapped
from solvers.soc.soc import SOC
from solvers.solution import both_costs, certificate_json, check_format, check_target, other_cost, write_json
from solvers.studies.commands import DropEdgeOption, UnitWeightsOption, compare_command, figures_command, tables_command

NOT_CONVERGED, NOT_CERTIFIED = 2, 3

app = typer.Typer(
    name="pgo",
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def pgo(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    """Pose graph optimisation by splitting, with a certified distance to the global optimum."""
    if version:
        typer.echo(f"pgo {installed_version()}")


@app.command("solve")
@explained_by_its_graph
def solve_command(
    graph: GraphArgument,
    out: Annotated[
        list[Path] | None,
        typer.Option("--out", "-o", help="Write .g2o, .tum, .kitti, .json, .png, .svg or .pdf; may be repeated."),
    ] = None,
    method: Annotated[
        choices.FirstStage | None,
        typer.Option(
            help="First stage: joint SOC (one robot), substructured SOC (robots and a driver, the same iterates), "
            "consensus SOC (robots alone), SOC as in the paper, or none before Newton. Joint unless given, or "
            "substructured where an option is about robots; joint is left out where Newton alone is faster."
        ),
    ] = None,
    robots: Annotated[
        int | None,
        typer.Option(min=1, help="Robots that share the poses; as the file has them (paper: one a pose) unless given."),
    ] = None,
    split: SplitOption = None,
    engine: Annotated[
        choices.Runner | None, typer.Option(help="Where robots run: in this process, in its threads, or as Ray actors.")
    ] = None,
    address: Annotated[
        str | None,
        typer.Option(help="HOST:PORT of a Ray cluster that this machine is part of; this machine unless given."),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            help="File to go on from, if it is there, and to write checkpoints to, for --resume after the run was "
            "broken off. Removed when the solve has converged."
        ),
    ] = None,
    driver_memory: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="GB that the driver of a solve by robots may take, 4 unless given; 0 is no driver, with --method "
            "consensus: poses, and no certificate.",
        ),
    ] = None,
    start: Annotated[
        choices.Start | None, typer.Option(help="Start: chordal relaxation (tree for the paper's method) unless given.")
    ] = None,
    r_step: Annotated[
        choices.BackEndName | None,
        typer.Option("--r-step", help="Back end of SOC's R-subproblem; factorized unless given."),
    ] = None,
    gap: GapOption = DEFAULT_GAP,
    max_iterations: Annotated[
        int | None,
        typer.Option(
            min=0, help=f"Most SOC iterations; default {HANDOVER.max_iterations}, paper {SOC.max_iterations}."
        ),
    ] = None,
    tolerance: Annotated[float | None, typer.Option(help="Residual at which Newton takes over from SOC.")] = None,
    time_limit: Annotated[float, typer.Option(help="Seconds for the iterations.")] = math.inf,
    unit_weights: UnitWeightsOption = False,
    information: InformationOption = False,
    skip_unknown: SkipUnknownOption = False,
    anchor: Annotated[
        int | None,
        typer.Option(metavar="ID", help="Pose held where the file has it, as by FIX; else aligned with the file's."),
    ] = None,
    times: Annotated[
        Path | None,
        typer.Option(help="Seconds of the poses, for .tum: a TUM file, or one number a line, in the order of the ids."),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(help="Write a report as .html: one page that opens offline, with pictures, tables and advice."),
    ] = None,
    covariances: Annotated[
        Path | None,
        typer.Option(help="Write covariances as .csv: id, upper triangle; x y (z) in world axes, m, then turn, rad."),
    ] = None,
    robust: Annotated[
        choices.Robust | None,
        typer.Option(
            help="Find wrong edges and leave them out, odometry taken to be right: graduated non-convexity with "
            "truncated least squares (gnc) or Geman-McClure (gm), pairwise consistency (pcm), or both (pcm-gnc)."
        ),
    ] = None,
    drop_edge: DropEdgeOption = None,
    threads: ThreadsOption = None,  # read by `solvers.command`, before BLAS is imported
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Print a line an iteration.")] = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Solve a pose graph: poses, their cost, a proven lower bound on the global optimum, and the gap."""
    given = {name for name, value in locals().items() if value is not None and value is not False}
    if verbose and (quiet or as_json):
        raise SettingError("--verbose prints a line an iteration, and --quiet and --json do not; give one of them")
    for path in out or []:
        check_format(path)  # before a long solve, not after it
    bar = sys.stderr.isatty() and not quiet
    if (engine is choices.Runner.RAY or address) and not (robots or split) and locate(graph).is_dir():
        more = sorted(given - choices.FOR_OWN_FILES)
        if more or len(out or []) > 1 or (out and out[0].suffix):  # robots have the files, and nobody the graph
            way_out = "takes the whole graph in one process; to have it read: --split given"
            raise SettingError(f"--{[*more, 'out FILE'][0].removeprefix('as_').replace('_', '-')} {way_out}")
        chosen = choices.chosen_method(method, None, True)
        pipeline = choices.chosen_pipeline(chosen, None, None, gap, max_iterations, tolerance, driver_memory)
        settings = partial(solve_folder, time_limit=time_limit, verbose=verbose, progress=bar)
        place = choices.chosen_engine(chosen, engine, address, False)
        found = settings(graph, pipeline, engine=place, out=out[0] if out else None)
        typer.echo("" if quiet else f"{found}\n", nl=False)
        raise typer.Exit(_exit_code(found.status, found.certificate))
    if report is not None:
        check_report(report)
    if covariances is not None and covariances.suffix.lower() != ".csv":
        raise SettingError(f"cannot write {covariances}: covariances are written as .csv")
    with JobBar(1, None, f"reading {graph}"):
        loaded = with_times(load_graph(graph, unit_weights, skip_unknown, drop_edge), times)
    problem = pose_problem(loaded, unit_weights, information)
    if note := memory_note(problem.graph):
        typer.echo(f"pgo: {note}", err=True)
    for path in out or []:
        check_target(path, problem.graph.num_robots)
    for other in filter(None, (report, resume, covariances)):
        check_writable(other)
    if robust is not None and method is not None and method is not choices.FirstStage.NEWTON:
        raise SettingError(f"--robust goes from its own start straight to Newton, got --method {method.value}")
    about_robots = (robots, split, engine, address, resume, driver_memory)
    is_shared = any(option is not None for option in about_robots)
    chosen = choices.chosen_method(method, robots, is_shared)
    if chosen is choices.FirstStage.JOINT and split is not None:
        raise SettingError(f"--method joint has one robot, got --split {split.value}; use substructured or consensus")
    runs_on = choices.chosen_engine(chosen, engine, address, resume is not None)
    is_shared |= chosen in (choices.FirstStage.SUBSTRUCTURED, choices.FirstStage.CONSENSUS)
    shared = choices.chosen_partition(problem.graph, robots, split) if is_shared else None
    # Robots factor; the other back ends of CONSENSUS have all robots in one place.
    on_robots = shared is not None and runs_on is not None and r_step in (None, choices.BackEndName.FACTORIZED)
    of_robots = (engine, address, resume, driver_memory)
    if r_step is not None and not on_robots and any(option is not None for option in of_robots):
        way_out = "leave out --engine, --resume and --driver-memory"
        raise SettingError(f"robots of an engine factor, got --r-step {r_step.value}; {way_out}")
    solution = solve(
        problem,
        choices.chosen_pipeline(chosen, shared, r_step, gap, max_iterations, tolerance, driver_memory),
        choices.chosen_start(problem, start),
        robust=choices.ROBUST[robust] if robust is not None else None,
        robots=shared if on_robots else None,
        engine=runs_on if on_robots else None,
        checkpoint=Checkpoint(resume) if resume is not None else None,
        anchor=pose_named(problem.graph, anchor) if anchor is not None else None,
        time_limit=time_limit,
        verbose=verbose,
        progress=bar,
    )
    solution = with_places(solution, graph, drop_edge)
    text, truth = str(solution), problem.graph.truth
    if truth is not None:
        bodies = problem.graph.bodies
        ate = absolute_trajectory_error(solution.poses[bodies], truth[bodies])
        text += f"\n\nerror to the truth (ATE): {ate:.4g} m"
    targets: list[tuple[Path, Callable[[Path], None]]] = [(path, solution.save) for path in out or []]
    if covariances is not None:
        named = problem.graph.in_files
        ids = problem.graph.pose_ids[named]
        targets.append((covariances, lambda to: write_covariances(solution.marginals()[named], ids, to)))
        with suppress(NotPositiveDefiniteError):  # writing will say so
            solution = replace(solution, covariances=solution.marginals() if report is not None else None)
    if report is not None:
        options = {"--unit-weights": unit_weights, "--information": information, "--skip-unknown": skip_unknown}
        words = [word for edge in drop_edge or () for word in ("--drop-edge", edge)]
        words += ["--robust", robust.value] if robust is not None else []
        source = shlex.join([graph, *(name for name, given in options.items() if given), *words])
        targets.append((report, partial(write_report, solution, source=source)))

    def show() -> None:
        typer.echo(wrapped(text, 13))
        for hint in (*hint_of_chi2(solution.problem, solution.poses), *hint_of_misfits(solution, graph, drop_edge)):
            typer.echo(f"\n{wrapped(hint)}")

    save_then_show(targets, show, solution.as_json if as_json else None, quiet)
    warn_of_weights(graph, problem, solution.certificate, drop_edge)
    raise typer.Exit(_exit_code(solution.status, solution.certificate))


def _exit_code(status: Status, certificate: Certificate) -> int:
    return NOT_CONVERGED if not status.is_success else DONE if certificate.is_certified else NOT_CERTIFIED


@app.command("certify")
@explained_by_its_graph
def certify_command(
    graph: GraphArgument,
    estimate: Annotated[
        Path | None,
        typer.Option("--estimate", "-e", help="Poses to judge: .g2o, .tum or .kitti; else the graph's VERTEX lines."),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the certificate as .json.")] = None,
    gap: GapOption = DEFAULT_GAP,
    unit_weights: UnitWeightsOption = False,
    information: InformationOption = False,
    skip_unknown: SkipUnknownOption = False,
    drop_edge: DropEdgeOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Judge anybody's poses: how far their cost can be above the global optimum."""
    if out is not None:
        if out.suffix.lower() != ".json":
            raise SettingError(f"cannot write {out}: a certificate is written as .json")
        check_writable(out)
    loaded = load_graph(graph, unit_weights, skip_unknown, drop_edge)
    problem = pose_problem(loaded, unit_weights, information)
    poses = estimated_poses(problem.graph, estimate)
    certificate = certify(problem, poses, gap)
    record = {
        "objective": certificate.objective,
        **both_costs(problem, poses),
        **certificate_json(certificate),
        "source": certificate.source.name,
        "best_known_objective": certificate.poses_objective,
        "versions": installed_versions(problem.backend),
    }
    targets = [(out, partial(write_json, record))] if out is not None else []
    rows = [f"{label:<12} {text}" for label, text in other_cost(problem, poses)]
    text = wrapped("\n".join([str(certificate), *rows]), 13)

    def show() -> None:
        typer.echo("\n".join([text, *map(wrapped, hint_of_chi2(problem, poses))]))

    save_then_show(targets, show, (lambda: record) if as_json else None, quiet)
    warn_of_weights(graph, problem, certificate, drop_edge)
    raise typer.Exit(DONE if certificate.is_certified else NOT_CERTIFIED)


@app.command("info")
@explained_by_its_graph
def info_command(
    graph: Annotated[
        str | None, typer.Argument(help="A g2o file, folder or data set; without it, versions and data sets.")
    ] = None,
    robots: Annotated[int | None, typer.Option(min=1, help="Show what sharing the poses among so many costs.")] = None,
    split: SplitOption = None,
    skip_unknown: SkipUnknownOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show what a pose graph is made of, or what this installation has."""
    if graph is None:
        if robots is not None or split is not None:
            raise SettingError("--robots and --split describe a graph; give one")
        rows = [*installation(), ("data sets", ", ".join(known_datasets()))]
        record: dict[str, object] = dict(rows)
    else:
        loaded = load_graph(graph, False, skip_unknown)
        rows = describe_graph(loaded)
        record = _figures(rows)
        if robots is not None or split is not None:
            shared = choices.chosen_partition(loaded, robots, split)
            costs = [("partition", shared.method.value), *report_partition(shared, loaded).facts()]
            rows += [("", ""), *costs]
            record["partition"] = _figures(costs)
    text = wrapped("\n".join(f"{label:<15} {text}" for label, text in rows), 16)
    save_then_show([], lambda: typer.echo(text), (lambda: record) if as_json else None)


def _figures(rows: list[tuple[str, str]]) -> dict[str, object]:
    """Rows for JSON: a text that is a number becomes one."""
    number = re.compile(r"-?\d+(\.\d+)?(e[-+]\d+)?")
    return {label: json.loads(text) if number.fullmatch(text) else text for label, text in rows}


@app.command("generate")
def generate_command(
    scene: Annotated[choices.Scene, typer.Argument(help="Which scene; the first three are the paper's.")],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="A .g2o file, or a name without suffix: a folder with one file a robot.")
    ],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random generator.")] = 0,
    poses: Annotated[
        int | None,
        typer.Option(min=2, help="Poses in all (random; victoria-park: 300) or a robot (grid-world); default 100."),
    ] = None,
    robots: Annotated[int | None, typer.Option(min=1, help="Robots (grid-world); 4 unless given.")] = None,
    dimension: Annotated[
        int | None,
        typer.Option("--dimension", "-d", min=2, max=3, help="Of space (random, grid-world); 3 unless given."),
    ] = None,
    translation_noise: Annotated[
        float | None, typer.Option(help="Standard deviation, metres (random, grid-world, victoria-park).")
    ] = None,
    rotation_noise: Annotated[
        float | None, typer.Option(help="Standard deviation, degrees (random, grid-world, victoria-park).")
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Generate a scene with known truth, written beside it as NAME.truth.tum."""
    rng, noise = np.random.default_rng(seed), (translation_noise, rotation_noise)
    made = choices.chosen_scene(scene, rng, poses, robots, dimension, *noise)
    truth = out.absolute().parent / f"{out.absolute().stem}.truth.tum"
    if out.suffix == "":
        # Symbols have 52 letters; poses of more robots are numbered, and the files alone say whose they are.
        named = replace(made, ids=symbol_ids(made.robots)) if made.num_robots <= MOST_SYMBOLS else made
        write_g2o_folder(named, out)
    elif out.suffix.lower() == ".g2o":
        write_g2o(made, out)
    else:
        raise SettingError(f"cannot write {out}: give a name that ends in .g2o, or a folder's name without a suffix")
    assert made.truth is not None
    write_tum(made.truth, truth)
    record = {**_figures(made.facts()), "written": [str(out), str(truth)]}
    text = f"{made!r}\nwritten: {out}\nwritten: {truth}"
    save_then_show([], lambda: typer.echo(text), (lambda: record) if as_json else None, quiet)


app.command("tables")(tables_command)
app.command("compare")(compare_command)
app.command("figures")(figures_command)


def main(arguments: list[str] | None = None) -> None:
    """Run `pgo` and leave with its exit code; every error and warning of ours is one line on stderr."""
    warnings.showwarning = lambda message, *_, **__: print(f"pgo: warning: {message}", file=sys.stderr)
    raise SystemExit(run_command(app, sys.argv[1:] if arguments is None else arguments))
