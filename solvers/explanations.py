"""Errors of a command explained by its graph: which weight cannot be factored, what took the memory."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numpy as np

from pgo_models.certificates.certificate import Certificate
from pgo_models.certificates.newton_polish import polish
from pgo_models.errors import GraphWarning, NotPositiveDefiniteError, PGOError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.datasets import load, locate
from pgo_models.graphs.g2o import edge_place
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.floating_point import UNIT_ROUNDOFF
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting

WORTH_SAYING = 1.01  # times its minimum: what chi2 has to be for a hint
P = ParamSpec("P")
T = TypeVar("T")


def explained_by_its_graph(command: Callable[P, T]) -> Callable[P, T]:
    """Wrap a command with an argument `graph`: errors that speak of no file are raised as ones that do."""

    @functools.wraps(command)
    def explained(*args: P.args, **kwargs: P.kwargs) -> T:
        graph = str(kwargs["graph"])
        try:
            return command(*args, **kwargs)
        except NotPositiveDefiniteError as error:
            raise NotPositiveDefiniteError(f"{extreme_weight(graph)} ({error})") from error
        except MemoryError as error:
            raise PGOError(
                f"{graph} takes more memory than there is; raise the limit, or share it among machines: "
                "pgo solve --robots K --address HOST:PORT"
            ) from error

    return explained


def warn_of_weights(graph: str, problem: PGOProblem, certificate: Certificate) -> None:
    """Name the weight beside which rounding hides more of the others than the gap asked for, if there is no proof."""
    heaviest = max(float(ratio.max()) for ratio in _ratios(problem.graph).values())
    if not certificate.is_certified and heaviest * UNIT_ROUNDOFF > certificate.wanted_gap:
        warnings.warn(extreme_weight(graph), GraphWarning, stacklevel=2)


def hint_of_chi2(problem: PGOProblem, poses: Poses) -> list[str]:
    """A line that names `--information` where F was asked for, and chi2 can be lowered by more than it is worth.

    Two Newton steps give a bound from above on its minimum.
    """
    graph = problem.graph
    if problem.weighting is not Weighting.ISOTROPIC or graph.information is None:
        return []
    whole = PGOProblem(graph, problem.backend, Weighting.INFORMATION)
    here, below = whole.objective(poses), whole.objective(polish(whole, poses, max_steps=2))
    if not here > WORTH_SAYING * below:
        return []
    return [f"the file's own cost: chi2 {here:.4g} here; its minimum is at most {below:.4g}: --information"]


def _ratios(graph: PoseGraph) -> dict[str, Array]:
    """Precisions over their medians; 1 where there is none."""
    values = {name: getattr(graph, name) for name in ("kappa", "tau")}
    return {name: np.where(one > 0, one / np.median(one[one > 0]), 1.0) for name, one in values.items()}


def extreme_weight(graph: str) -> str:
    """Sentence on the precision farthest from the median of its kind: file and line, edge, value, and the way out."""
    path = locate(graph)
    if not (path.is_file() or path.is_dir()):
        return f"{graph}: weights too far apart for doubles; give it as a file to be told which"
    with warnings.catch_warnings(action="ignore"):
        loaded = load(path, skip_unknown=True)
    ratios = _ratios(loaded)
    name = max(ratios, key=lambda one: float(np.abs(np.log(ratios[one])).max()))
    e = int(np.argmax(np.abs(np.log(ratios[name]))))
    i, j = int(loaded.pose_ids[loaded.i[e]]), int(loaded.pose_ids[loaded.j[e]])
    value, names = float(getattr(loaded, name)[e]), (loaded.pose_name(loaded.i[e]), loaded.pose_name(loaded.j[e]))
    return (
        f"{edge_place(path, (i, j))}: {name} of edge {' -> '.join(names)} is {value:.3g}, {ratios[name][e]:.3g} "
        f"times the median; weights from {min(loaded.kappa.min(), loaded.tau.min()):.3g} to "
        f"{max(loaded.kappa.max(), loaded.tau.max()):.3g} and lengths up to {np.abs(loaded.t_ij).max():.3g} m "
        "are too far apart for doubles; correct the information matrix, or use --unit-weights"
    )
