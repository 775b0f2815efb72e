"""What a pose graph is made of, in words and numbers."""

import numpy as np

from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import condition
from pgo_models.graphs.residuals import Chi2Convention, chi2
from pgo_models.problem.initialization import chordal_start, spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from solvers.reporting.versions import installed_versions

_MUCH = 5e8  # bytes that are worth a word


def describe_graph(graph: PoseGraph) -> list[tuple[str, str]]:
    """What `pgo info` says of a graph: label and text of every row."""
    degree = np.bincount(np.concatenate([graph.i, graph.j]), minlength=graph.num_poses)
    rows, sizes = graph.facts(), [str(len(part)) for part in graph.components()]
    parts, degrees = f"(sizes {', '.join(sizes[:5])})", f"{degree.min()} to {degree.max()}, mean {degree.mean():.2f}"
    rows[4:5] = [("components", f"{len(sizes)} {parts}"), ("degree", degrees)]
    rows[8:8] = _information_facts(graph)
    if len(sizes) == 1:
        problem, estimate = PGOProblem(graph), graph.initial
        if estimate is not None:
            rows.append(("F, estimate", f"{problem.objective(estimate):.8g}"))
            if graph.information is not None:
                rows += [(f"chi2, {one.name.lower()}", f"{chi2(graph, estimate, one):.8g}") for one in Chi2Convention]
        rows.append(("F, tree", f"{problem.objective(spanning_tree_start(graph)):.8g}"))
        note = memory_note(graph)
        rows.append(("memory", note) if note else ("F, chordal", f"{problem.objective(chordal_start(problem)):.8g}"))
    rows.append(("Cholesky", installed_versions(None)["cholesky"]))
    return rows


def memory_note(graph: PoseGraph) -> str:
    """How much memory a solve will take, in words; nothing where it is little.

    About 600 (n + m) bytes and the Cholesky factor: 390 k log2 k bytes in the plane, 1250 k^(4/3) in space, as nested
    dissection fills lattices, with k = min(n, 2 (m - n + 1)), the poses that are left where chains are eliminated. To
    20 % on grid worlds of 10,000 to a million poses in the plane, to 50,000 in space; narrow graphs take less.
    """
    n, m = graph.num_poses, graph.num_edges
    k = max(2, min(n, 2 * (m - n + 1)))
    needed = 600.0 * (n + m) + (390.0 * k * np.log2(k) if graph.d == 2 else 1250.0 * k ** (4 / 3))
    return f"a solve takes about {1e-9 * needed:.2g} GB of memory" if needed > _MUCH else ""


def _information_facts(graph: PoseGraph) -> list[tuple[str, str]]:
    if graph.information is None:
        return []
    d, rows = graph.d, []
    for name, block in (("I_tt", slice(0, d)), ("I_rr", slice(d, None))):
        ratio = condition(graph.information[:, block, block])
        rows.append((name, f"condition {np.median(ratio):.3g} in the median, at most {ratio.max():.3g}"))
    coupled = int(graph.information[:, :d, d:].any(axis=(1, 2)).sum())
    return [*rows, ("I_tr", f"not zero in {coupled} of {graph.num_edges} edges")]
