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

_WORTH_MENTIONING = 5e8  # bytes of memory
_SHOWN_COMPONENTS = 5  # of which the sizes are listed


def describe_graph(graph: PoseGraph, indefinite: str = "") -> list[tuple[str, str]]:
    """Rows that `pgo info` prints of a graph: label and text of each.

    `indefinite` is `text_of_indefinite` with a place in the file, if that is known.
    """
    is_indefinite = indefinite_edges(graph)
    if is_indefinite.any() and not indefinite:
        indefinite = text_of_indefinite(graph, is_indefinite)
    rows = graph.facts()
    components = graph.components()
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
    """Costs of the estimate and of the starts, or the memory that a solve takes if it is a lot."""
    problem = PGOProblem(graph, weighting=Weighting.ISOTROPIC)
    name = problem.cost_name
    rows = []
    estimate = graph.initial
    if estimate is not None:
        rows.append((f"{name}, estimate", rounded_up(problem.objective(estimate), 8)))
        if has_chi2:
            for convention in Chi2Convention:
                cost = rounded_up(chi2(graph, estimate, convention), 8)
                rows.append((f"chi2, {convention.name.lower()}", cost))
    rows.append((f"{name}, tree", rounded_up(problem.objective(spanning_tree_start(graph)), 8)))
    note = memory_note(graph)
    if note:
        rows.append(("memory", note))
    else:
        rows.append((f"{name}, chordal", rounded_up(problem.objective(chordal_start(problem)), 8)))
    return rows


def memory_note(graph: PoseGraph) -> str:
    """How much memory a solve takes, in words; empty if it is little."""
    needed = memory_of_a_solve(graph)
    if needed <= _WORTH_MENTIONING:
        return ""
    return f"a solve takes about {1e-9 * needed:.2g} GB of memory"


def memory_of_a_solve(graph: PoseGraph) -> float:
    """Memory that a solve in one process takes, in bytes, beside the program and the graph.

    It is about 600 (n + m) bytes, and the Cholesky factor: 390 k log2 k bytes in the plane,
    850 k^(4/3) in space, as nested dissection fills lattices. Here k = min(n, 2 (m - n + 1)) is the
    number of poses that are left after chains are eliminated. The estimate is right to 20 % on grid
    worlds of 10,000 to a million poses in the plane, and to 30 % on those of 12,500 to 100,000 in
    space. Narrow graphs take less, and lattices in space two to three times as much.
    """
    n = graph.num_poses
    m = graph.num_edges
    k = max(2, min(n, 2 * (m - n + 1)))
    factor = 390.0 * k * np.log2(k) if graph.d == 2 else 850.0 * k ** (4 / 3)
    return float(600.0 * (n + m) + factor)


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
