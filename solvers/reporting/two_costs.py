"""The two costs of poses, F and chi2: which of them was solved, and what the other one is."""

from pgo_models.figures import rounded_up
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.precisions import indefinite_edges
from pgo_models.graphs.residuals import chi2
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting, name_of_cost
from solvers.reporting.notes import joined_notes, note_of_absence, note_of_coupling

Facts = list[tuple[str, str]]  # labels and texts, as they are printed
_SAME_COST = 1e-9  # relative difference below which two costs are one


def both_costs(problem: PGOProblem, poses: Poses) -> dict[str, float | str | None]:
    """What `.json` files hold of the costs of poses: F, chi2 (chordal), which of them is the cost.

    chi2 is None without a file's matrices, or where these are indefinite; `edges_without_coupling`
    counts those whose coupling blocks it leaves out, and `note` says so if it is the cost. Both are
    None of rotations alone in a graph with translations, which would be part of them.
    """
    graph = problem.graph
    weighting = problem.weighting
    isotropic = problem
    if weighting is not Weighting.ISOTROPIC:
        isotropic = PGOProblem(graph, problem.backend, Weighting.ISOTROPIC)
    is_complete = problem.has_translations == graph.has_translations
    has_chi2 = graph.information is not None and not indefinite_edges(graph).any()
    num_uncoupled = 0 if graph.uncoupled is None else int(graph.uncoupled.sum())
    return {
        "unknowns": "poses" if problem.has_translations else "rotations",
        "weighting": weighting.name if isinstance(weighting, Weighting) else "GIVEN",
        "F": isotropic.objective(poses) if is_complete else None,
        "chi2": chi2(graph, poses) if is_complete and has_chi2 else None,
        "edges_without_coupling": num_uncoupled,
        "note": joined_notes(note_of_absence(len(graph.absent)), note_of_coupling(problem)),
    }


def other_cost(problem: PGOProblem, poses: Poses) -> Facts:
    """Line of a summary on the cost that has no bound; empty if it equals the bounded one."""
    costs = both_costs(problem, poses)
    other = costs["chi2"]
    other_weighting = Weighting.INFORMATION
    weights = "the file's information matrices"
    if costs["edges_without_coupling"]:
        weights += f", without the coupling blocks of {costs['edges_without_coupling']} edges"
    if costs["weighting"] == "INFORMATION":
        other = costs["F"]
        other_weighting = Weighting.ISOTROPIC
        num_precisions = "two precisions" if problem.has_translations else "one precision"
        weights = f"{num_precisions} an edge"
    objective = problem.objective(poses)
    if not isinstance(other, float) or abs(other - objective) <= _SAME_COST * objective:
        return []
    name = name_of_cost(other_weighting, problem.has_translations)
    bounded = problem.cost_name
    return [(name, f"{rounded_up(other)} with {weights}; the bound is on {bounded} alone")]


def facts_of_unknowns(problem: PGOProblem, of_poses: str) -> Facts:
    """What a summary says where the unknowns are rotations alone, and why they are.

    `of_poses` says what becomes of the translations of the poses.
    """
    if problem.has_translations:
        return []
    why = "no edge measures a translation"
    if problem.graph.has_translations:
        why = "measured translations are left out"
    return [("unknowns", f"rotations alone: {why}, and those of the poses are {of_poses}")]
