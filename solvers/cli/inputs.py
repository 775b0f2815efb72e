"""What the arguments of `pgo` name: graphs, edges, problems, poses and their times."""

import os
import shlex
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pgo_models.errors import FileFormatError, GraphError, GraphWarning, PGOError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.datasets import load, locate, places_of_edges
from pgo_models.graphs.g2o import digits_of_vertices, read_g2o_poses
from pgo_models.graphs.g2o_readings import Reading
from pgo_models.graphs.partitioning import Partition, PartitionMethod, partition, suited_partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import (
    indefinite_edges,
    text_of_indefinite,
    without_indefinite_coupling,
)
from pgo_models.graphs.trajectories import read_kitti, read_times, read_tum
from pgo_models.graphs.written_digits import ALL_DIGITS, WrittenDigits, digits_of
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.cli.options import Cost, Split

LARGE_FILE = 5_000_000  # bytes, which take about half a second to read
Dropped = list[str] | None  # edges to leave out, by LINE or FILE:LINE


@dataclass(frozen=True)
class GraphOptions:
    """A graph as the command line names it, and the options that change its problem.

    `graph` is a file, folder or data set. `drop_edge` are edges to leave out, by LINE or FILE:LINE.
    """

    graph: str
    cost: Cost | None = None
    drop_coupling: bool = False
    skip_unknown: bool = False
    drop_edge: Dropped = None
    rotations: bool = False
    trust_folder: bool = False
    largest_component: bool = False
    estimate_noise: bool = False

    def __post_init__(self) -> None:
        asked = self._asked
        if self.estimate_noise and self.cost is Cost.UNIT:
            raise SettingError(
                "--estimate-noise and --cost unit ask for different weights; leave out one"
            )
        if len(set(asked.values())) > 1:
            first, second = list(asked)[:2]
            raise SettingError(f"{first} and {second} ask for different costs; leave out one")

    @property
    def _asked(self) -> dict[str, str]:
        """The cost that every option asks for."""
        asked = {
            "--rotations": "rotations" if self.rotations else "",
            "--cost": self.cost.value if self.cost is not None else "",
            "--drop-coupling": Cost.CHI2.value if self.drop_coupling else "",
        }
        return {option: cost for option, cost in asked.items() if cost}

    @property
    def chosen_cost(self) -> Cost | None:
        """The cost that was asked for; None for the graph's own."""
        if self.rotations:
            return None
        return next((Cost(cost) for cost in self._asked.values()), None)

    def loaded(self) -> PoseGraph:
        """The graph, without the edges to leave out."""
        has_unit_weights = self.chosen_cost is Cost.UNIT or self.estimate_noise
        loaded = load_graph(
            self.graph,
            has_unit_weights,
            self.skip_unknown,
            self.drop_edge,
            trust_folder=self.trust_folder,
            largest_component=self.largest_component,
        )
        return with_estimated_noise(loaded) if self.estimate_noise else loaded

    def problem(self, loaded: PoseGraph) -> PGOProblem:
        """Problem of the loaded graph, with the cost that was asked for, or its own.

        A SettingError where chi2 is asked for and there are no information matrices. A GraphError
        names the first indefinite matrix by `file:line`, unless the coupling blocks of such
        matrices are to be left out.
        """
        if self.rotations:
            return PGOProblem(loaded, weighting=Weighting.ROTATIONS)
        cost = self.chosen_cost
        if cost is None:
            return PGOProblem(loaded)
        if cost is not Cost.CHI2:
            return PGOProblem(loaded, weighting=Weighting.ISOTROPIC)
        if loaded.information is None:
            (option,) = list(self._asked)[:1]
            raise SettingError(
                f"{option} is for information matrices, and {loaded.name} has none; leave it out"
            )
        if self.drop_coupling:
            loaded = without_indefinite_coupling(loaded)
        elif indefinite := indefinite_matrices(loaded, self.graph, self.drop_edge):
            raise GraphError(
                f"{indefinite}, so that chi2 can be negative: correct them, "
                "add --drop-coupling to go without their coupling blocks, "
                "or take --cost isotropic"
            )
        return PGOProblem(loaded, weighting=Weighting.INFORMATION)

    @property
    def is_as_written(self) -> bool:
        """Whether the whole graph is solved, with the weights of its file."""
        is_whole = not (self.drop_edge or self.rotations or self.largest_component)
        has_own_weights = self.chosen_cost is not Cost.UNIT and not self.estimate_noise
        return is_whole and has_own_weights and not self.skip_unknown

    @property
    def in_commands(self) -> str:
        """The name of the graph with all these options, as one types them."""
        options = {
            "--rotations": self.rotations,
            "--drop-coupling": self.drop_coupling,
            "--skip-unknown": self.skip_unknown,
            "--trust-folder": self.trust_folder,
            "--largest-component": self.largest_component,
            "--estimate-noise": self.estimate_noise,
        }
        cost = self.chosen_cost
        if cost in (Cost.ISOTROPIC, Cost.UNIT):
            options[f"--cost {cost.value}"] = True
        return graph_in_commands(self.graph, options, self.drop_edge)


def takes_long_to_read(graph: str) -> bool:
    """Whether it may take long to read a graph: a large file, a folder, or one to download."""
    try:
        path = locate(graph, download=False)
    except PGOError:
        return True  # whoever reads it finds out why
    return path.is_dir() or path.stat().st_size >= LARGE_FILE


def graph_in_commands(graph: str, options: Mapping[str, bool], dropped: Dropped) -> str:
    """The name of a graph in commands to type, with the options that change the problem."""
    words = [graph]
    for name, is_given in options.items():
        words += name.split() if is_given else []
    for edge in dropped or ():
        words += ["--drop-edge", edge]
    return shlex.join(words)


def check_outputs_differ(outputs: Mapping[str, Path | list[Path] | None]) -> None:
    """Raise a SettingError where two options, or one given twice, write the same file."""
    option_of: dict[Path, str] = {}
    for option, given in outputs.items():
        paths = given if isinstance(given, list) else [given]
        for path in paths:
            if path is None:
                continue
            target = Path(os.path.realpath(path))
            earlier = option_of.get(target)
            if earlier is not None:
                both = f"{option} twice" if earlier == option else f"{earlier} and {option}"
                raise SettingError(f"{path} would be written by {both}; give two names")
            option_of[target] = option


def load_graph(
    graph: str,
    unit_weights: bool,
    skip_unknown: bool = False,
    dropped: Dropped = None,
    reading: Reading = Reading.AS_WRITTEN,
    trust_folder: bool = False,
    largest_component: bool = False,
) -> PoseGraph:
    """Graph of a file, folder or data set, without the edges to leave out.

    With `largest_component`, the poses and edges of other components are left out, too. The rest is
    as for `read_g2o`.
    """
    loaded = load(
        graph,
        reading=reading,
        unit_weights=unit_weights,
        skip_unknown=skip_unknown,
        trust_folder=trust_folder,
    )
    if dropped:
        kept, _ = kept_edges(graph, dropped)
        loaded = loaded.without_edges(~kept)
    return _largest_component(loaded) if largest_component else loaded


def with_estimated_noise(graph: PoseGraph) -> PoseGraph:
    """The graph with weights of the noise that its edges have; what that is goes to stderr."""
    from solvers.studies.noise import estimate_noise

    estimate = estimate_noise(graph)
    print(f"pgo: noise of {estimate}, estimated from the measurements", file=sys.stderr)
    return estimate.graph


def _largest_component(graph: PoseGraph) -> PoseGraph:
    """The largest component of a graph; a GraphWarning says what is left out."""
    largest, *others = graph.parts()
    if not others:
        return graph
    part = graph.subgraph(largest)
    poses = f"{graph.num_poses - part.num_poses} poses (with {graph.pose_name(others[0][0])})"
    edges = f"{graph.num_edges - part.num_edges} edges"
    kept = f"the largest of {len(others) + 1} components is taken"
    warnings.warn(f"{graph.name}: {kept}, without {poses} and {edges}", GraphWarning, stacklevel=2)
    return part


def components_of(graph: PoseGraph) -> list[PoseGraph]:
    """Components of a graph that have edges, the largest first, each with its number in its name.

    A GraphWarning says how many poses have no edges.
    """
    parts = graph.parts()
    with_edges = [part for part in parts if len(part) > 1]
    num_alone = len(parts) - len(with_edges)
    if num_alone:
        first = graph.pose_name(int(next(part[0] for part in parts if len(part) == 1)))
        warnings.warn(
            f"{graph.name}: {num_alone} poses without edges (the first is {first}) are left out",
            GraphWarning,
            stacklevel=2,
        )
    if len(with_edges) == 1 and not num_alone:
        return [graph]
    components = []
    for number, part in enumerate(with_edges, 1):
        name = f"{graph.name}, component {number} of {len(with_edges)}"
        components.append(replace(graph.subgraph(part), name=name))
    return components


def kept_edges(graph: str, dropped: Dropped) -> tuple[BoolArray, list[str]]:
    """Whether each edge is kept, (m,), and `file:line` of those that are.

    An edge is named by its line, in a folder by `FILE:LINE`, with or without the folder. A
    SettingError where a name is that of no edge, or of several.
    """
    path = locate(graph)
    if not (path.is_file() or path.is_dir()):
        raise SettingError(f"{graph} can be read only once; give it as a file to name its edges")
    with warnings.catch_warnings(action="ignore"):
        places = places_of_edges(path)
    kept = np.ones(len(places), dtype=bool)
    for name in dropped or ():
        kept[_edge_named(name, graph, places)] = False
    return kept, [place for place, is_kept in zip(places, kept, strict=True) if is_kept]


def _edge_named(name: str, graph: str, places: Sequence[str]) -> int:
    """Number of the edge with this name; a SettingError where it is not that of one edge."""
    endings = (f"/{name}", f":{name}")
    named = [e for e, place in enumerate(places) if f"/{place}".endswith(endings)]
    if len(named) == 1:
        return named[0]
    count = f"{len(named)} edges are" if named else "no edge is"
    raise SettingError(f"{count} at {name} of {graph}; name it LINE or FILE:LINE, as {places[0]}")


def indefinite_matrices(loaded: PoseGraph, graph: str, dropped: Dropped = None) -> str:
    """How many information matrices are indefinite, and `file:line` of the first; "" for none."""
    is_indefinite = indefinite_edges(loaded)
    if not is_indefinite.any():
        return ""
    path = locate(graph)
    place = ""
    if path.is_file() or path.is_dir():
        _, places = kept_edges(graph, dropped)
        place = places[int(np.argmax(is_indefinite))]
    return text_of_indefinite(loaded, is_indefinite, place)


def chosen_partition(graph: PoseGraph, number: int | None, split: Split | None) -> Partition:
    """Partition of the options, by default among as many robots as the file names.

    Errors are those of `partition`, and a SettingError for a number that a split excludes.
    """
    if split is Split.SINGLETONS and number not in (None, graph.num_poses):
        raise SettingError(
            f"--split singletons makes {graph.num_poses} robots, got --robots {number}; "
            "leave one out"
        )
    number = graph.num_robots if number is None else number
    if split is None:
        return suited_partition(graph, number)
    return partition(graph, number, PartitionMethod[split.name])


def with_times(graph: PoseGraph, path: Path | None) -> PoseGraph:
    """Graph with the times in a file, one for every pose."""
    if path is None:
        return graph
    times = read_times(path)
    if len(times) != len(graph.bodies):
        problem = f"{len(times)} times, {graph.name} has {len(graph.bodies)} poses; give one each"
        raise FileFormatError(path, None, problem)
    return replace(graph, times=times)


def pose_named(graph: PoseGraph, name: int) -> int:
    """Number of the pose with this id; a SettingError where there is none."""
    ids = graph.pose_ids
    numbers = np.flatnonzero(ids == name)
    if not len(numbers):
        raise SettingError(
            f"{graph.name} has no pose {name} to anchor; "
            f"its ids are from {ids.min()} to {ids.max()}"
        )
    return int(numbers[0])


def estimated_poses(graph: PoseGraph, path: Path | None) -> Poses:
    """Poses in a file, else those that came with the graph.

    A FileFormatError unless the file has a pose for each of the graph's, and no others; a
    SettingError where the graph has no poses, or the suffix is that of no format.
    """
    if path is None:
        if graph.initial is None:
            raise SettingError(
                f"{graph.name} has no VERTEX line for every pose; give --estimate FILE"
            )
        return graph.initial
    suffix = path.suffix.lower()
    if suffix in (".g2o", ".gz", ".json"):  # of Open3D, which has the poses of its nodes
        return read_g2o_poses(path, graph)
    poses = _read_trajectory(path, graph.d)
    if poses.num_poses != len(graph.in_files):
        known = f"{graph.name} has {len(graph.in_files)}"
        known += ", with its landmarks" if len(graph.landmarks) else ""
        problem = f"{poses.num_poses} poses, {known}; give one each, or a .g2o file"
        raise FileFormatError(path, None, problem)
    return graph.completed(poses)


def digits_of_estimate(graph: str, estimate: Path | None) -> WrittenDigits:
    """Digits that the poses of `estimated_poses` are written with.

    All digits where they come from neither a g2o file nor a trajectory.
    """
    path = Path(graph) if estimate is None else estimate
    if not path.is_file():
        return ALL_DIGITS
    if path.suffix.lower() in (".tum", ".txt", ".kitti"):
        return digits_of(np.loadtxt(path, ndmin=2)[:, -7:].ravel())
    if path.suffix.lower() != ".g2o":
        return ALL_DIGITS
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GraphWarning)  # they have been shown
        return digits_of_vertices(path)


def _read_trajectory(path: Path, d: int) -> Poses:
    """Poses of a TUM or KITTI trajectory, as the suffix says; a SettingError for another suffix."""
    suffix = path.suffix.lower()
    if suffix in (".tum", ".txt"):
        return read_tum(path, d)
    if suffix == ".kitti":
        return read_kitti(path, d)
    raise SettingError(
        f"cannot read {path}: no format has suffix {suffix!r}; "
        "use .g2o, .json of Open3D, .tum or .kitti"
    )
