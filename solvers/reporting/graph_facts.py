"""Facts of a pose graph, in words and numbers: its size, its weights, and what a solve takes."""

import numpy as np

from pgo_models.figures import rounded_up
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import condition, indefinite_edges, text_of_indefinite
from pgo_models.graphs.residuals import Chi2Convention, chi2
from pgo_models.problem.initialization import chordal_start, spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.reporting.versions import installed_versions

_SHOWN_COMPONENTS = 5  # of which the sizes are listed


def describe_graph(graph: PoseGraph, indefinite: str = "") -> list[tuple[str, str]]:
    """Rows that `pgo info` prints of a graph: label and text of each.

    `indefinite` is `text_of_indefinite` with a place in the file, if that is known.
    """
    is_indefinite = indefinite_edges(graph)
    if is_indefinite.any() and not indefinite:
        indefinite = text_of_indefinite(graph, is_indefinite)
    rows = graph.facts()
    components = graph.parts()
    sizes = ", ".join(str(len(part)) for part in components[:_SHOWN_COMPONENTS])
    degree = np.bincount(np.concatenate([graph.i, graph.j]), minlength=graph.num_poses)
    degrees = f"{degree.min()} to {degree.max()}, mean {degree.mean():.2f}"
    rows[4:5] = [("components", f"{len(components)} (sizes {sizes})"), ("degree", degrees)]
    information = _information_facts(graph)
    if indefinite:
        information.append(("chi2", f"none: {indefinite}"))
    rows[8:8] = information
    if len(components) == 1:
        has_chi2 = graph.information is not None and not indefinite
        rows += _cost_facts(graph, has_chi2)
    rows.append(("Cholesky", installed_versions(None)["cholesky"]))
    return rows


def _cost_facts(graph: PoseGraph, has_chi2: bool) -> list[tuple[str, str]]:
    """Costs of the estimate and of the starts."""
    problem = PGOProblem(graph, weighting=Weighting.ISOTROPIC)
    name = problem.cost_name
    rows = []
    if graph.initial is not None:
        estimate = graph.with_world_of(graph.initial)
        rows.append((f"{name}, estimate", rounded_up(problem.objective(estimate), 8)))
        if has_chi2:
            for convention in Chi2Convention:
                cost = rounded_up(chi2(graph, estimate, convention), 8)
                rows.append((f"chi2, {convention.name.lower()}", cost))
    rows.append(
        (f"{name}, tree", rounded_up(problem.objective(spanning_tree_start(problem.graph)), 8))
    )
    rows.append((f"{name}, chordal", rounded_up(problem.objective(chordal_start(problem)), 8)))
    return rows


def _information_facts(graph: PoseGraph) -> list[tuple[str, str]]:
    """Rows on the blocks of the information matrices: translations, rotations, coupling."""
    if graph.information is None:
        return []
    d = graph.d
    rows = []
    for name, block in (("I_tt", slice(0, d)), ("I_rr", slice(d, None))):
        ratio = condition(graph.information[:, block, block])
        text = f"condition {np.median(ratio):.3g} in the median, at most {ratio.max():.3g}"
        rows.append((name, text))
    is_coupled = graph.information[:, :d, d:].any(axis=(1, 2))
    rows.append(("I_tr", f"not zero in {int(is_coupled.sum())} of {graph.num_edges} edges"))
    return rows
