"""`pgo certify`: a proven bound for poses from anywhere."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pgo_models.certificates.certificate import DEFAULT_GAP, Certificate, Verdict
from pgo_models.certificates.proof_file import save_proof
from pgo_models.errors import SettingError
from pgo_models.figures import rounded_up
from pgo_models.files import check_writable
from pgo_models.geometry.poses import Poses
from pgo_models.problem.problem import PGOProblem
from solvers.cli.explanations import edge_fit, explained_by_its_graph, show_advice, warn_of_weights
from solvers.cli.inputs import (
    GraphOptions,
    digits_of_estimate,
    estimated_poses,
    graph_in_commands,
)
from solvers.cli.options import (
    CostOption,
    DropCouplingOption,
    DropEdgeOption,
    GapOption,
    GraphArgument,
    LargestComponentOption,
    ProofOption,
    RotationsOption,
    SkipUnknownOption,
    TrustFolderOption,
)
from solvers.cli.shell import (
    DONE,
    NOT_CERTIFIED,
    JsonOption,
    QuietOption,
    save_then_show,
    wrapped,
)
from solvers.reporting.json_records import certificate_json, write_json
from solvers.reporting.notes import joined_notes, verdict_suffix
from solvers.reporting.two_costs import both_costs, facts_of_unknowns, other_cost
from solvers.reporting.versions import installed_versions
from solvers.solves.given_poses import certify, certify_to_digits

_INDENT = 13  # columns of the labels of a certificate


@explained_by_its_graph
def certify_command(
    graph: GraphArgument,
    estimate: Annotated[
        Path | None,
        typer.Option(
            "--estimate",
            "-e",
            help="Poses to judge: .g2o, .tum or .kitti; else the graph's VERTEX lines.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Write the certificate as .json.")
    ] = None,
    proof: ProofOption = None,
    gap: GapOption = DEFAULT_GAP,
    cost: CostOption = None,
    rotations: RotationsOption = False,
    drop_coupling: DropCouplingOption = False,
    skip_unknown: SkipUnknownOption = False,
    trust_folder: TrustFolderOption = False,
    largest_component: LargestComponentOption = False,
    drop_edge: DropEdgeOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run `pgo certify`."""
    if out is not None and out.suffix.lower() != ".json":
        raise SettingError(f"cannot write {out}: a certificate is written as .json")
    for path in (out, proof):
        if path is not None:
            check_writable(path)
    source = GraphOptions(
        graph,
        cost,
        drop_coupling,
        skip_unknown,
        drop_edge,
        rotations,
        trust_folder,
        largest_component,
    )
    problem = source.problem(source.loaded())
    poses = estimated_poses(problem.graph, estimate)
    certificate = certify(problem, poses, gap)
    to_digits = None
    if not certificate.is_certified:
        written = digits_of_estimate(graph, estimate)
        to_digits = certify_to_digits(problem, poses, certificate, written)
    record = _record(problem, poses, certificate)
    if to_digits is not None:
        record["note"] = joined_notes(_text_of_digits(to_digits), str(record["note"]))
        record["optimal_to_digits"] = True
        record["polished_gap"] = to_digits.proven_gap
    files = ((out, partial(write_json, record)), (proof, partial(save_proof, problem, certificate)))
    targets = [(path, save) for path, save in files if path is not None]

    def show() -> None:
        typer.echo(_text(problem, poses, certificate, str(record["note"])))
        options = {"--skip-unknown": skip_unknown, "--trust-folder": trust_folder}
        name = graph_in_commands(graph, options, drop_edge)
        fit = edge_fit(problem, poses, graph, drop_edge)
        show_advice(fit.advice_on_cost(f"pgo solve {name}"))

    save_then_show(targets, show, (lambda: record) if as_json else None, quiet)
    warn_of_weights(graph, problem, certificate, drop_edge)
    is_optimal = certificate.is_certified or to_digits is not None
    holds = is_optimal and not len(problem.graph.absent)
    raise typer.Exit(DONE if holds else NOT_CERTIFIED)


def _text_of_digits(polished: Certificate) -> str:
    """Sentence on poses that are optimal but for the digits that they are written with."""
    gap = rounded_up(polished.printed_gap, 1)
    what = "exact" if polished.verdict is Verdict.EXACT else f"the gap is {gap}"
    return f"optimal to the digits written; polished, {what}"


def _record(problem: PGOProblem, poses: Poses, certificate: Certificate) -> dict[str, object]:
    """What `.json` files hold of poses and their certificate."""
    return {
        "objective": certificate.objective,
        **both_costs(problem, poses),
        **certificate_json(certificate),
        "polished": None if certificate.polished is None else certificate.polished.as_dict(),
        "source": certificate.source.name,
        "best_known_objective": certificate.poses_objective,
        "versions": installed_versions(problem.backend),
    }


def _text(problem: PGOProblem, poses: Poses, certificate: Certificate, note: str) -> str:
    """The certificate as it is printed, with a note and with the cost that is not bounded."""
    rows = [("note", note)] if note else []
    rows += other_cost(problem, poses)
    rows += facts_of_unknowns(problem, of_poses="ignored")
    lines = [str(certificate)]
    num_absent = len(problem.graph.absent)
    if num_absent:
        lines.insert(0, f"{'graph':<12} {problem.graph.name}{verdict_suffix(num_absent)}")
    lines += [f"{label:<12} {text}" for label, text in rows]
    return wrapped("\n".join(lines), _INDENT)
