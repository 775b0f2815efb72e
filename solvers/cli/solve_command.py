"""`pgo solve`: a pose graph solved and certified, with what is written and printed of it."""

import math
import sys
from collections.abc import Callable
from contextlib import nullcontext, redirect_stdout
from dataclasses import dataclass, replace
from functools import cache, partial
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from pgo_models.certificates.certificate import DEFAULT_GAP
from pgo_models.errors import SettingError
from pgo_models.files import check_writable
from pgo_models.geometry.poses import absolute_rotation_error, absolute_trajectory_error
from pgo_models.graphs.datasets import locate
from pgo_models.graphs.foreign_files import certain_edges
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.plots.style import is_picture, plotly
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.carry.process import Engine
from solvers.cli import choices
from solvers.cli.explanations import (
    advice_on_file,
    edge_fit_of_solution,
    explained_by_its_graph,
    reading_that_is_meant,
    show_advice,
    warn_of_weights,
    with_covariances,
    with_places,
)
from solvers.cli.inputs import (
    GraphOptions,
    check_outputs_differ,
    chosen_partition,
    components_of,
    pose_named,
    takes_long_to_read,
    with_times,
)
from solvers.cli.options import (
    AllComponentsOption,
    Cost,
    CostOption,
    DropCouplingOption,
    DropEdgeOption,
    EstimateNoiseOption,
    FirstStage,
    GapOption,
    GraphArgument,
    LargestComponentOption,
    ProofOption,
    Robust,
    RotationsOption,
    Runner,
    SkipUnknownOption,
    Split,
    SplitOption,
    Start,
    TakenForRight,
    TrustFolderOption,
)
from solvers.cli.shell import (
    DONE,
    NOT_CERTIFIED,
    NOT_CONVERGED,
    JsonOption,
    QuietOption,
    is_standard_output,
    print_g2o,
    save_then_show,
    wrapped,
)
from solvers.pipeline import solve
from solvers.progress.bars import JobBar
from solvers.reporting.result_files import check_format, check_target
from solvers.request import Pipeline
from solvers.result import Status
from solvers.robots.settings import Checkpoint, Robots
from solvers.soc.soc import SOC, WARM_START
from solvers.solution import Solution

if TYPE_CHECKING:
    from solvers.robust.consistency import PCM
    from solvers.robust.gnc import GNC

_INDENT = 13  # columns of the labels of a solution


@explained_by_its_graph
def solve_command(
    graph: GraphArgument,
    out: Annotated[
        list[Path] | None,
        typer.Option(
            "--out",
            "-o",
            help="Write .g2o, .tum, .kitti, .json, .png, .svg or .pdf; - prints .g2o, and nothing "
            "else; may be repeated.",
        ),
    ] = None,
    method: Annotated[
        FirstStage | None,
        typer.Option(
            help="First stage: joint SOC (one robot), substructured SOC (robots and a driver, the "
            "same iterates), consensus SOC (robots alone), SOC as in the paper, or none before "
            "Newton. Joint unless given, or substructured where an option is about robots; joint "
            "is left out where Newton alone is faster."
        ),
    ] = None,
    robots: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Robots that share the poses; as the file has them (paper: one a pose) unless "
            "given.",
        ),
    ] = None,
    split: SplitOption = None,
    engine: Annotated[
        Runner | None,
        typer.Option(help="Where robots run: in this process, in its threads, or as Ray actors."),
    ] = None,
    address: Annotated[
        str | None,
        typer.Option(
            help="HOST:PORT of a Ray cluster that this machine is part of; this machine unless "
            "given."
        ),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            help="File to go on from, if it is there, and to write checkpoints to, for --resume "
            "after the run was broken off. Removed when the solve has converged."
        ),
    ] = None,
    driver_memory: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="GB that the driver of a solve by robots may take, 4 unless given; 0 is no "
            "driver, with --method consensus: poses, and no certificate.",
        ),
    ] = None,
    start: Annotated[
        Start | None,
        typer.Option(help="Start: chordal relaxation (tree for the paper's method) unless given."),
    ] = None,
    gap: GapOption = DEFAULT_GAP,
    max_iterations: Annotated[
        int | None,
        typer.Option(
            min=0,
            help=f"Most SOC iterations; default {WARM_START.max_iterations}, "
            f"paper {SOC.max_iterations}.",
        ),
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(help="Residual at which Newton takes over from SOC.")
    ] = None,
    time_limit: Annotated[float, typer.Option(help="Seconds for the iterations.")] = math.inf,
    cost: CostOption = None,
    rotations: RotationsOption = False,
    drop_coupling: DropCouplingOption = False,
    skip_unknown: SkipUnknownOption = False,
    trust_folder: TrustFolderOption = False,
    largest_component: LargestComponentOption = False,
    all_components: AllComponentsOption = False,
    estimate_noise: EstimateNoiseOption = False,
    anchor: Annotated[
        int | None,
        typer.Option(
            metavar="ID",
            help="Pose held where the file has it, as by FIX; else aligned with the file's.",
        ),
    ] = None,
    times: Annotated[
        Path | None,
        typer.Option(
            help="Seconds of the poses, for .tum: a TUM file, or one number a line, in the order "
            "of the ids."
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            help="Write a report as .html: one page that opens offline, with pictures, tables and "
            "advice."
        ),
    ] = None,
    film: Annotated[
        Path | None,
        typer.Option(
            help="Write a film as .html: SOC and Newton on the graph from a spanning tree, with "
            "the cost and the proven bound of every iterate."
        ),
    ] = None,
    covariances: Annotated[
        Path | None,
        typer.Option(
            help="Write covariances as .csv: id, upper triangle; x y (z) in world axes, m, then "
            "turn, rad."
        ),
    ] = None,
    proof: ProofOption = None,
    robust: Annotated[
        Robust | None,
        typer.Option(
            help="Find wrong edges and leave them out: graduated non-convexity with truncated "
            "least squares (gnc) or Geman-McClure (gm), pairwise consistency (pcm), or both "
            "(pcm-gnc)."
        ),
    ] = None,
    known: Annotated[
        TakenForRight | None,
        typer.Option(
            help="With --robust, edges taken for right: odometry, which joins consecutive poses; "
            "none; or odometry unless cycles of edges contradict it (auto, the default)."
        ),
    ] = None,
    prove_outliers: Annotated[
        bool,
        typer.Option(
            "--prove-outliers",
            help="With --robust: prove closures wrong that no map at least as good keeps, odometry "
            "taken to be right, and bound the truncated cost of every map.",
        ),
    ] = False,
    drop_edge: DropEdgeOption = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Print a line an iteration.")
    ] = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run `pgo solve`."""
    given = _given_options(locals())
    source = GraphOptions(
        graph,
        cost,
        drop_coupling,
        skip_unknown,
        drop_edge,
        rotations,
        trust_folder,
        largest_component,
        estimate_noise,
    )
    stages = StageOptions(
        method,
        start,
        gap,
        max_iterations,
        tolerance,
        time_limit,
        robust,
        known,
        prove_outliers,
    )
    network = RobotOptions(robots, split, engine, address, resume, driver_memory)
    is_printed = any(map(is_standard_output, out or []))
    if is_printed and (verbose or as_json):
        raise SettingError("--out - prints the graph alone; leave out --verbose and --json")
    display = Display(verbose, quiet or is_printed, as_json)
    outputs = Outputs(out or [], report, film, covariances, proof, resume)
    if prove_outliers and robust is None:
        raise SettingError("--prove-outliers is of a robust solve; add --robust gnc")
    network.check_without_driver(stages, outputs.proof, graph)
    if network.reads_own_files(graph):
        _refuse_what_needs_the_graph(given, outputs, source.chosen_cost)
        raise typer.Exit(_solve_own_files(source, stages, network, display, outputs))
    outputs.check_pages()
    with JobBar(1, None if takes_long_to_read(graph) else False, f"reading {graph}"):
        loaded = with_times(source.loaded(), times)
    if network.has_no_driver and source.chosen_cost is None and not rotations:
        source = replace(source, cost=Cost.ISOTROPIC)
    if not all_components:
        raise typer.Exit(_solve_graph(loaded, source, stages, network, outputs, display, anchor))
    if largest_component:
        raise SettingError("--largest-component takes one component, and --all-components each")
    raise typer.Exit(_solve_components(loaded, source, stages, network, outputs, display, anchor))


@dataclass(frozen=True)
class StageOptions:
    """Options about the stages of a solve."""

    method: FirstStage | None
    start: Start | None
    gap: float
    max_iterations: int | None
    tolerance: float | None
    time_limit: float
    robust: Robust | None
    known: TakenForRight | None
    prove_outliers: bool  # whether edges that are rejected are to be proven wrong

    @property
    def wrong_edges(self) -> "GNC | PCM | None":
        """Method that --robust and --known ask for; None for a plain solve."""
        return choices.chosen_robust(self.robust, self.known)

    def wrong_edges_of(self, graph: PoseGraph, path: Path) -> "GNC | PCM | None":
        """The method for a graph of a file; what the file itself calls certain is known."""
        method = self.wrong_edges
        certain = certain_edges(path) if method is not None and self.known is None else None
        if method is None or certain is None or len(certain) != graph.num_edges:
            return method
        return replace(method, known=certain)

    def check_robust(self) -> None:
        """Raise a SettingError where a robust solve is to have a first stage."""
        if self.robust is None or self.method in (None, FirstStage.NEWTON):
            return
        raise SettingError(
            f"--robust goes from its own start straight to Newton, got --method {self.method.value}"
        )

    def pipeline(
        self, method: FirstStage, robots: Partition | None, has_driver: bool = True
    ) -> Pipeline:
        """Pipeline of these options with the method that was chosen."""
        return choices.chosen_pipeline(
            method,
            robots,
            self.gap,
            self.max_iterations,
            self.tolerance,
            has_driver,
            is_asked_for=self.method is not None,
        )


@dataclass(frozen=True)
class ChosenPlace:
    """Where a solve is run: the method, the robots if it has any, and where these run.

    Without an engine everything is run in one place, also a method that has robots.
    """

    method: FirstStage
    partition: Partition | None
    engine: Engine | None


@dataclass(frozen=True)
class RobotOptions:
    """Options about robots."""

    robots: int | None
    split: Split | None
    engine: Runner | None
    address: str | None
    resume: Path | None
    driver_memory: float | None

    @property
    def is_given(self) -> bool:
        """Whether any of these options was given."""
        return self.robots is not None or self.split is not None or self.is_about_network

    @property
    def is_about_network(self) -> bool:
        """Whether one of the options was given that need robots of an engine."""
        options = (self.engine, self.address, self.resume, self.driver_memory)
        return any(option is not None for option in options)

    @property
    def has_no_driver(self) -> bool:
        """Whether robots do without a driver."""
        return self.driver_memory == 0

    def robots_at(self, place: ChosenPlace) -> Robots | None:
        """Robots of a solve, or None where it is run in one place."""
        memory = choices.chosen_memory(place.method, self.driver_memory)
        if place.engine is None:
            return None
        return Robots(place.partition, place.engine, memory, checkpoint=self.checkpoint)

    @property
    def checkpoint(self) -> Checkpoint | None:
        """Checkpoint of the file that --resume names; None without it."""
        if self.resume is None:
            return None
        return Checkpoint(self.resume)

    def reads_own_files(self, graph: str) -> bool:
        """Whether the robots are on a Ray cluster, and each is to read its own file of a folder."""
        is_on_ray = self.engine is Runner.RAY or bool(self.address)
        is_shared_anew = bool(self.robots or self.split)
        return is_on_ray and not is_shared_anew and locate(graph).is_dir()

    def check_without_driver(self, stages: StageOptions, proof: Path | None, graph: str) -> None:
        """Raise a SettingError where robots without a driver are asked for what needs one."""
        if not self.has_no_driver:
            return
        no_driver = "--driver-memory 0 is no driver"
        if proof is not None:
            raise SettingError(
                f"{no_driver}, and then nothing is proven: no proof to write; leave out --proof, "
                "or --driver-memory 0"
            )
        if stages.robust is not None:
            raise SettingError(f"{no_driver}, and --robust needs one; leave out one of the two")
        if self.reads_own_files(graph):
            raise SettingError(
                f"{no_driver}, and robots with files of their own need one; leave it out, or have "
                "the graph read in one process: --split given --method consensus"
            )
        if stages.method is not FirstStage.CONSENSUS:
            raise SettingError(
                "without a driver robots run CONSENSUS alone: add --method consensus, "
                "or leave out --driver-memory 0"
            )

    def chosen_for(self, graph: PoseGraph, stages: StageOptions) -> ChosenPlace:
        """Where the solve is run; a SettingError when the options do not go together."""
        method = choices.chosen_method(stages.method, self.robots, self.is_given)
        if method is FirstStage.JOINT and self.split is not None:
            raise SettingError(
                f"--method joint has one robot, got --split {self.split.value}; "
                "use substructured or consensus"
            )
        has_checkpoint = self.resume is not None
        engine = choices.chosen_engine(method, self.engine, self.address, has_checkpoint)
        partition = None
        if self.is_given or method in (FirstStage.SUBSTRUCTURED, FirstStage.CONSENSUS):
            partition = chosen_partition(graph, self.robots, self.split)
        return ChosenPlace(method, partition, engine if partition is not None else None)


@dataclass(frozen=True)
class Display:
    """What is printed: a line an iteration, the result, errors and warnings alone, or JSON."""

    verbose: bool
    quiet: bool
    as_json: bool

    def __post_init__(self) -> None:
        if self.verbose and (self.quiet or self.as_json):
            raise SettingError(
                "--verbose prints a line an iteration, and --quiet and --json do not; "
                "give one of them"
            )

    @property
    def has_bar(self) -> bool:
        """Whether bars show the progress, on a terminal."""
        return sys.stderr.isatty() and not self.quiet


@dataclass(frozen=True)
class Outputs:
    """Files that are to be written; they are checked before a long solve, not after it."""

    out: list[Path]
    report: Path | None
    film: Path | None
    covariances: Path | None
    proof: Path | None
    resume: Path | None

    def __post_init__(self) -> None:
        check_outputs_differ(
            {
                "--out": self.out,
                "--resume": self.resume,
                "--report": self.report,
                "--film": self.film,
                "--covariances": self.covariances,
                "--proof": self.proof,
            }
        )
        for path in self.out:
            if not is_standard_output(path):
                check_format(path)

    def numbered(self, number: int) -> "Outputs":
        """The same files with a number in their names, NAME.2.g2o for NAME.g2o."""

        def with_number(path: Path | None) -> Path | None:
            if path is None or is_standard_output(path):
                return path
            return path.with_name(f"{path.stem}.{number}{path.suffix}")

        out = [path for path in map(with_number, self.out) if path is not None]
        others = (self.report, self.film, self.covariances, self.proof, self.resume)
        return Outputs(out, *map(with_number, others))

    def check_pages(self) -> None:
        """Raise an error where report, film or covariances have a name of another format."""
        if self.report is not None:
            from solvers.report.report import check_report

            check_report(self.report)
        if self.film is not None:
            plotly("graph_objects")  # or the line that names the extra
            if self.film.suffix.lower() != ".html":
                raise SettingError(f"cannot write {self.film}: films are written as .html")
        if self.covariances is not None and self.covariances.suffix.lower() != ".csv":
            raise SettingError(f"cannot write {self.covariances}: covariances are written as .csv")

    def check_drawable(self, problem: PGOProblem) -> None:
        """Raise an error for a picture, report or film of rotations alone."""
        for path in (*self.out, self.report, self.film):
            if path is not None and (path in (self.report, self.film) or is_picture(path)):
                problem.check_positions(str(path))

    def check_writable(self, num_robots: int) -> None:
        """Raise an error for the first file or folder that cannot be written."""
        for path in self.out:
            if not is_standard_output(path):
                check_target(path, num_robots)
        for other in (self.report, self.film, self.resume, self.covariances, self.proof):
            if other is not None:
                check_writable(other)


def _solve_graph(
    loaded: PoseGraph,
    source: GraphOptions,
    stages: StageOptions,
    network: RobotOptions,
    outputs: Outputs,
    display: Display,
    anchor: int | None,
) -> int:
    """Solve a graph that has been read, write and show the solution; the exit code."""
    problem = source.problem(loaded)
    outputs.check_drawable(problem)
    outputs.check_writable(problem.graph.num_robots)
    stages.check_robust()
    place = network.chosen_for(problem.graph, stages)
    solution = solve(
        problem,
        stages.pipeline(place.method, place.partition, not network.has_no_driver),
        choices.chosen_start(problem, stages.start),
        robust=stages.wrong_edges_of(problem.graph, Path(source.graph)),
        robots=network.robots_at(place),
        anchor=pose_named(problem.graph, anchor) if anchor is not None else None,
        time_limit=stages.time_limit,
        verbose=display.verbose,
        progress=display.has_bar,
    )
    if stages.prove_outliers:
        from solvers.robust_solves.outlier_proof import prove_outliers as with_proof

        solution = with_proof(solution, stages.time_limit)
    solution = with_places(solution, source.graph, source.drop_edge)
    _save_and_show(solution, source, stages, outputs, display)
    warn_of_weights(source.graph, problem, solution.certificate, source.drop_edge)
    num_absent = len(problem.graph.absent)
    return _exit_code(solution.status, solution.is_certified, num_absent)


def _solve_components(
    loaded: PoseGraph,
    source: GraphOptions,
    stages: StageOptions,
    network: RobotOptions,
    outputs: Outputs,
    display: Display,
    anchor: int | None,
) -> int:
    """Solve every component of a graph as `_solve_graph` does; the largest exit code.

    JSON is a list of their records, printed when all are solved.
    """
    if anchor is not None:
        pose_named(loaded, anchor)
    codes = []
    records = []
    for number, component in enumerate(components_of(loaded), 1):
        named = outputs if number == 1 else outputs.numbered(number)
        held = anchor if anchor in component.pose_ids else None
        with redirect_stdout(StringIO()) if display.as_json else nullcontext() as printed:
            codes.append(_solve_graph(component, source, stages, network, named, display, held))
        if printed is not None:
            records.append(printed.getvalue())
    if display.as_json:
        typer.echo(f"[\n{','.join(records)}]")
    return max(codes)


def _given_options(arguments: dict[str, object]) -> set[str]:
    """Names of the arguments that were given, or have a default that is not empty."""
    return {name for name, value in arguments.items() if value is not None and value is not False}


def _refuse_what_needs_the_graph(given: set[str], outputs: Outputs, cost: Cost | None) -> None:
    """Raise a SettingError for an option that robots with own files cannot serve.

    Nobody has the whole graph then.
    """
    others = sorted(given - choices.FOR_OWN_FILES)
    out = outputs.out
    if not others and (len(out) > 1 or (out and out[0].suffix)):
        others = ["out FILE"]
    if not others and cost is Cost.UNIT:
        others = ["cost unit"]
    if others:
        option = others[0].removeprefix("as_").replace("_", "-")
        raise SettingError(
            f"--{option} takes the whole graph in one process; to have it read: --split given"
        )


def _solve_own_files(
    source: GraphOptions,
    stages: StageOptions,
    network: RobotOptions,
    display: Display,
    outputs: Outputs,
) -> int:
    """Solve a folder whose files the robots read themselves; the exit code."""
    from solvers.solves.folder_solve import solve_folder

    weightings = {
        None: Weighting.OWN,
        Cost.CHI2: Weighting.INFORMATION,
        Cost.ISOTROPIC: Weighting.ISOTROPIC,
    }
    method = choices.chosen_method(stages.method, None, True)
    pipeline = stages.pipeline(method, None)
    engine = choices.chosen_engine(method, network.engine, network.address, False)
    memory = choices.chosen_memory(method, network.driver_memory)
    solution = solve_folder(
        source.graph,
        pipeline,
        weighting=weightings[source.chosen_cost],
        robust=stages.wrong_edges,
        robots=Robots(engine=engine, driver_memory=memory),
        out=outputs.out[0] if outputs.out else None,
        time_limit=stages.time_limit,
        verbose=display.verbose,
        progress=display.has_bar,
        trust_folder=source.trust_folder,
    )
    if not display.quiet:
        typer.echo(f"{solution}")
    return _exit_code(solution.status, solution.is_certified, solution.num_absent)


def _save_and_show(
    solution: Solution,
    source: GraphOptions,
    stages: StageOptions,
    outputs: Outputs,
    display: Display,
) -> None:
    """Write every file, then print the solution and what to try next, or JSON."""
    command_source = source.in_commands
    if stages.robust is not None:
        command_source += f" --robust {stages.robust.value}"
        if stages.known is not None:
            command_source += f" --known {stages.known.value}"
    # The edges are judged once, and only where that is shown.
    judged = cache(partial(edge_fit_of_solution, solution, source.graph, source.drop_edge))
    targets = _files_of_solution(solution, outputs)
    if outputs.report is not None:

        def save_report(path: Path) -> None:
            from solvers.report.report import write_report

            has_covariances = outputs.covariances is not None
            reported = with_covariances(solution) if has_covariances else solution
            write_report(reported, path, source=command_source, fit=judged())

        targets.append((outputs.report, save_report))

    def show() -> None:
        typer.echo(wrapped(_text_with_error(solution), _INDENT))
        if not solution.has_ended:  # its status says what to do
            return
        is_robust = stages.robust is not None
        if not is_robust:
            meant = reading_that_is_meant(judged(), source)
            show_advice(meant or advice_on_file(judged(), solution.problem.graph, source))
            if meant:  # then the edges need not be wrong
                return
        show_advice(judged().advice(f"pgo solve {command_source}", is_robust=is_robust))

    record = solution.as_json if display.as_json else None
    save_then_show(targets, show, record, display.quiet)


def _files_of_solution(
    solution: Solution, outputs: Outputs
) -> list[tuple[Path, Callable[[Path], None]]]:
    """Files that need the solution alone, and the functions that write them."""
    targets: list[tuple[Path, Callable[[Path], None]]] = []
    for path in outputs.out:
        to_terminal = is_standard_output(path)
        save = partial(_print_solution, solution) if to_terminal else solution.save
        targets.append((path, save))
    if outputs.proof is not None:
        targets.append((outputs.proof, solution.save_proof))
    if outputs.film is not None:

        def save_film(path: Path) -> None:
            from pgo_models.plots.pages import save_page
            from solvers.reporting.film import film

            save_page(film(solution.problem), path)

        targets.append((outputs.film, save_film))
    if outputs.covariances is not None:
        graph = solution.problem.graph
        ids = graph.pose_ids[graph.in_files]

        def save_covariances(path: Path) -> None:
            from pgo_models.problem.marginals import write_covariances

            has_translations = solution.problem.has_translations
            write_covariances(solution.marginals(), ids, path, has_translations)

        targets.append((outputs.covariances, save_covariances))
    return targets


def _print_solution(solution: Solution, _: Path) -> None:
    print_g2o(solution.save)


def _text_with_error(solution: Solution) -> str:
    """The printed solution, with the distance to the truth of a generated scene."""
    graph = solution.problem.graph
    if graph.truth is None:
        return str(solution)
    bodies = graph.bodies
    estimate = solution.all_poses[bodies]
    truth = graph.with_world_of(graph.truth)[bodies]
    if not solution.problem.has_translations:
        error = np.rad2deg(absolute_rotation_error(estimate, truth))
        return f"{solution}\n\nerror to the truth, of rotations: {error:.4g} degrees"
    error = absolute_trajectory_error(estimate, truth)
    return f"{solution}\n\nerror to the truth (ATE): {error:.4g} m"


def _exit_code(status: Status, is_certified: bool, num_absent: int) -> int:
    """Exit code of a solve that has ended.

    What is certified without absent robots is no certificate of the graph that was asked for.
    """
    if not status.is_success:
        return NOT_CONVERGED
    return DONE if is_certified and num_absent == 0 else NOT_CERTIFIED
