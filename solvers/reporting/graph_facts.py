"""What a pose graph is made of, in words and numbers."""

import numpy as np

from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import condition
from pgo_models.graphs.residuals import Chi2Convention, chi2
from pgo_models.problem.initialization import chordal_start, spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from solvers.reporting.versions import installed_versions


def describe_graph(graph: PoseGraph) -> list[tuple[str, str]]:
    """What `pgo info` says of a graph: label and text of every row."""
    degree = np.bincount(np.concatenate([graph.i, graph.j]), minlength=graph.num_poses)
    rows, sizes = graph.facts(), [str(len(part)) for part in graph.components()]
    rows[4:5] = [
        ("components", f"{len(sizes)} (sizes {', '.join(sizes[:5])})"),
        ("degree", f"{degree.min()} to {degree.max()}, mean {degree.mean():.2f}"),
    ]
    rows[8:8] = _information_facts(graph)
    if len(sizes) == 1:
        problem = PGOProblem(graph)
        if graph.initial is not None:
            rows.append(("F, estimate", f"{problem.objective(graph.initial):.8g}"))
            if graph.information is not None:
                rows += [
                    (f"chi2, {one.name.lower()}", f"{chi2(graph, graph.initial, one):.8g}") for one in Chi2Convention
                ]
        rows.append(("F, tree", f"{problem.objective(spanning_tree_start(graph)):.8g}"))
        rows.append(("F, chordal", f"{problem.objective(chordal_start(problem)):.8g}"))
    rows.append(("Cholesky", installed_versions(None)["cholesky"]))
    return rows


def _information_facts(graph: PoseGraph) -> list[tuple[str, str]]:
    if graph.information is None:
        return []
    d, rows = graph.d, []
    for name, block in (("I_tt", slice(0, d)), ("I_rr", slice(d, None))):
        ratio = condition(graph.information[:, block, block])
        rows.append((name, f"condition {np.median(ratio):.3g} in the median, at most {ratio.max():.3g}"))
    coupled = int(graph.information[:, :d, d:].any(axis=(1, 2)).sum())
    return [*rows, ("I_tr", f"not zero in {coupled} of {graph.num_edges} edges")]
