"""What can be solved where: every cell of the guide's table is tried on a tiny graph.

A cell works, and its result is the one that a solve in one place has, or it is refused in one
sentence. `PYTHONPATH=tests python tests/thorough/test_capabilities.py` prints the table anew.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from graphs import informed, planar_lattice, varied_graph
from networks import KEY, Network, give_edge

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel, PGOError, PoseGraph, Weighting, victoria_park
from pgo_models.graphs.g2o import write_g2o_folder
from solvers import SweptScene
from solvers.place import Automatic
from solvers.result import Stage
from solvers.riemannian.prefixes import GrowingStart
from solvers.robots_solution import RobotsSolution
from solvers.studies.tightness import noisy_scene

PAGE = Path(__file__).parents[2] / "notebooks/site/guide/capabilities.md"
WORKS = "yes"
MISSING = "no"
Answer = "Solution | RobotsSolution | Apart"


def consensus(graph: PoseGraph) -> solvers.SOC:
    """SOC by two robots that agree on the poses that they share."""
    return solvers.SOC(coupling=solvers.Coupling.CONSENSUS, robots=pgo.partition(graph, 2))


@dataclass(frozen=True)
class Place:
    """Where a graph is solved, for the table: `run` raises a PGOError where that is refused."""

    name: str
    run: Callable[..., Answer]

    def solve(
        self,
        graph: PoseGraph,
        pipeline: solvers.Pipeline | None = None,
        weighting: Weighting = Weighting.OWN,
        **options: Any,
    ) -> Answer:
        return self.run(graph, pipeline or solvers.Pipeline(), weighting, **options)


def here(
    graph: PoseGraph, pipeline: solvers.Pipeline, weighting: Weighting, **options: Any
) -> Answer:
    return solvers.solve(pgo.PGOProblem(graph, weighting=weighting), pipeline, **options)


def with_driver(
    graph: PoseGraph, pipeline: solvers.Pipeline, weighting: Weighting, **options: Any
) -> Answer:
    robots = replace(options.pop("robots", solvers.Robots()), owners=2)
    return here(graph, pipeline, weighting, robots=robots, **options)


def without_driver(
    graph: PoseGraph, pipeline: solvers.Pipeline, weighting: Weighting, **options: Any
) -> Answer:
    if pipeline.soc is Automatic.AUTO:
        pipeline = replace(pipeline, soc=consensus(graph))
    robots = replace(options.pop("robots", solvers.Robots()), owners=2, driver_memory=0.0)
    return here(graph, pipeline, weighting, robots=robots, **options)


def own_files(
    graph: PoseGraph, pipeline: solvers.Pipeline, weighting: Weighting, **options: Any
) -> Answer:
    unknown = set(options) - {"callback", "time_limit", "robots", "robust"}
    if unknown:
        raise pgo.PGOError(f"solve_folder has no option {unknown.pop()}")
    if isinstance(pipeline.soc, solvers.SOC):  # who owns which poses is in the files
        pipeline = replace(pipeline, soc=replace(pipeline.soc, robots=None))
    with tempfile.TemporaryDirectory() as folder:
        robots = np.arange(graph.num_poses) * 2 // graph.num_poses
        if graph.world is not None:
            robots[graph.world] = 0
        write_g2o_folder(graph.with_robots(robots), Path(folder) / "robots")
        return solvers.solve_folder(
            Path(folder) / "robots", pipeline, weighting=weighting, **options
        )


@dataclass(frozen=True)
class Rejected:
    """Edges that were left out, (m,)."""

    rejected: np.ndarray


@dataclass(frozen=True, eq=False)
class Apart:
    """What robots that are apart know of a graph, and their network."""

    graph: PoseGraph
    network: Network

    @property
    def robot(self) -> solvers.Robot:
        return self.network.robots["r1"]

    @property
    def certificate(self) -> pgo.Certificate:
        if self.robot.solution is None:
            raise pgo.PGOError(self.robot.failure)
        return self.robot.solution.certificate

    @property
    def note(self) -> str:
        assert self.robot.solution is not None
        return self.robot.solution.note

    @property
    def stages(self) -> tuple[Stage, ...]:
        assert self.robot.solution is not None
        return self.robot.solution.stages

    @property
    def robust(self) -> Rejected:
        ids = self.graph.pose_ids
        pairs = zip(ids[self.graph.i].tolist(), ids[self.graph.j].tolist(), strict=True)
        left_out = {pair for robot in self.network.robots.values() for pair in robot.rejected}
        return Rejected(np.array([pair in left_out for pair in pairs]))

    def marginals(self) -> np.ndarray:
        found = {}
        for robot in self.network.robots.values():
            found |= robot.covariances
        return np.array([found[pose] for pose in sorted(found)])

    def extended(self, grown: PoseGraph) -> bool:
        """Whether an edge that is measured later is solved with the rest."""
        give_edge(self.network.robots["r0"], grown, grown.num_edges - 1)
        before = self.robot.outcome
        self.network.run(60.0)
        after = self.robot.outcome
        assert before is not None
        assert after is not None
        lines = [
            sum(revision.num_lines for revision in outcome.revisions.values())
            for outcome in (before, after)
        ]
        return lines[1] == lines[0] + 1


def apart(
    graph: PoseGraph,
    pipeline: solvers.Pipeline,
    weighting: Weighting,
    lost: float = 0.0,
    **options: Any,
) -> Apart:
    unknown = set(options) - {"robust", "callback"}
    if unknown:
        raise pgo.PGOError(
            f"robots that are apart have no {unknown.pop()} in a solve; Robot.save keeps what one "
            "of them has measured and knows"
        )
    robust = options.get("robust")
    names = ["r0", "r1"]
    robots = {}
    with tempfile.TemporaryDirectory() as folder:
        owners = np.arange(graph.num_poses) * 2 // graph.num_poses
        if graph.world is not None:
            owners[graph.world] = 0
        write_g2o_folder(graph.with_robots(owners), Path(folder) / "robots")
        for k, name in enumerate(names):
            robots[name] = solvers.Robot(
                name,
                names,
                KEY,
                pipeline=pipeline,
                weighting=weighting,
                sharing=solvers.Sharing.MEASUREMENTS,
                robust=robust,
                retry=0.3,
            )
            robots[name].read(Path(folder) / "robots" / f"{k}.g2o")
    network = Network(robots, np.random.default_rng(0), lost=lost)
    network.run(120.0)
    return Apart(graph, network)


HERE = Place("here", here)
APART = Place("robots that are apart", apart)
PLACES = (
    HERE,
    Place("robots and a driver", with_driver),
    Place("robots without a driver", without_driver),
    Place("robots with own files", own_files),
    APART,
)


def has_cost_of(place: Place, graph: PoseGraph, weighting: Weighting) -> bool:
    """Whether a place finds the cost that a solve here has."""
    answer = place.solve(graph, weighting=weighting)
    best = HERE.solve(graph, weighting=weighting).certificate.objective
    return bool(answer.certificate.objective <= best * (1.0 + 1e-3))


def graph_in_space() -> PoseGraph:
    return varied_graph(3, 8, 3)


def graph_with_matrices() -> PoseGraph:
    return informed(2, 8, 2, False, 1.0, NoiseModel(0.02, 0.02))


def graph_with_gps() -> PoseGraph:
    graph = varied_graph(1, 8, 2)
    assert graph.truth is not None
    return graph.with_position_prior(np.arange(4), graph.truth.t[:4], 10.0)


def solves_landmarks(place: Place) -> bool:
    graph = victoria_park(np.random.default_rng(0), num_poses=30)
    return has_cost_of(place, graph, Weighting.ISOTROPIC)


def finds_a_wrong_edge(robust: solvers.GNC | solvers.PCM, place: Place) -> bool:
    graph = pgo.grid_world(1, 30, 5, d=2)
    measured = pgo.Poses(np.eye(2)[None], np.array([[30.0, 40.0]]))
    spoiled = graph.with_edges(np.array([2]), np.array([25]), measured, 100.0, 100.0)
    answer = place.solve(spoiled, robust=robust)
    if isinstance(answer, RobotsSolution):  # the robots know which ones
        return bool(answer.num_rejected)
    rejection = getattr(answer, "robust", None)
    return rejection is not None and bool(rejection.rejected[-1])


def has_covariances(place: Place) -> bool:
    answer = place.solve(graph_with_matrices(), weighting=Weighting.ISOTROPIC)
    if isinstance(answer, RobotsSolution):
        raise pgo.PGOError("its solution has no poses, and so no covariances of them")
    return answer.marginals().shape == (8, 3, 3)


def certifies_by_terms(place: Place) -> bool:
    noise = np.deg2rad(70.0)
    graph = noisy_scene(SweptScene.CIRCLE, noise, np.random.default_rng(0))
    answer = place.solve(graph, weighting=Weighting.ISOTROPIC)
    refuse_what_the_note_names(answer, "HandednessAscent")
    return answer.certificate.bound.terms is not None


def certifies_in_complex_numbers(place: Place) -> bool:
    answer = place.solve(planar_lattice(4, 4, 0.5), weighting=Weighting.ISOTROPIC)
    refuse_what_the_note_names(answer, "ComplexRelaxation")
    return answer.certificate.bound.is_complex


def refuse_what_the_note_names(answer: Answer, step: str) -> None:
    """Raise a PGOError where a solution says that a step, or all after SOC, were not taken."""
    if step in answer.note or "no driver" in answer.note:
        raise pgo.PGOError(answer.note)


def grows(place: Place) -> bool:
    """On odometry with closures that fit no map."""
    rng = np.random.default_rng(1)
    along = np.arange(13)
    far = np.array([rng.choice(14, 2, replace=False) for _ in range(12)])
    i, j = np.concatenate([np.stack([along, along + 1], axis=1), far]).T
    R_ij = pgo.random_rotations(25, 2, rng)
    graph = PoseGraph(14, i, j, R_ij, rng.standard_normal((25, 2)), np.ones(25), np.ones(25))
    pipeline = solvers.Pipeline(growing=GrowingStart(first_size=6), other_starts=False)
    answer = place.solve(graph, pipeline, Weighting.ISOTROPIC)
    refuse_what_the_note_names(answer, "growing start")
    return any(stage.name.startswith("growing start") for stage in answer.stages)


def writes_checkpoints(place: Place) -> bool:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.checkpoint"
        place.solve(
            graph_in_space(),
            robots=solvers.Robots(checkpoint=solvers.Checkpoint(path)),
            callback=lambda *_: True,
            weighting=Weighting.ISOTROPIC,
        )
        return path.exists()


def extends(place: Place) -> bool:
    answer = place.solve(graph_in_space(), weighting=Weighting.ISOTROPIC)
    grown = varied_graph(3, 8, 3).with_edges(
        np.array([0]), np.array([5]), pgo.Poses(np.eye(3)[None], np.zeros((1, 3))), 1e-3, 1e-3
    )
    if isinstance(answer, Apart):
        return answer.extended(grown)
    if isinstance(answer, RobotsSolution):
        raise pgo.PGOError("extend takes a Solution, which has poses")
    return solvers.extend(answer, grown).problem.graph.num_edges == grown.num_edges


def bears_faults(place: Place) -> bool:
    if place is APART:
        return has_cost_of(Place("", partial(apart, lost=0.3)), graph_in_space(), Weighting.OWN)
    pipeline = solvers.Pipeline(soc=consensus(graph_in_space()))
    robots = solvers.Robots(faults=solvers.Faults())
    answer = place.solve(graph_in_space(), pipeline, Weighting.ISOTROPIC, robots=robots)
    return answer.status.is_success


def runs_soc(soc: Callable[[], Any]) -> Callable[[Place], bool]:
    def run(place: Place) -> bool:
        pipeline = solvers.Pipeline(soc=soc())
        answer = place.solve(graph_in_space(), pipeline, Weighting.ISOTROPIC)
        return any("SOC" in stage.name for stage in answer.stages)

    return run


@dataclass(frozen=True)
class Capability:
    """A row of the table, and how it is tried in a place."""

    name: str
    works: Callable[[Place], bool]


CAPABILITIES = (
    Capability("F", lambda place: has_cost_of(place, graph_in_space(), Weighting.ISOTROPIC)),
    Capability(
        "chi2", lambda place: has_cost_of(place, graph_with_matrices(), Weighting.INFORMATION)
    ),
    Capability(
        "priors, GPS", lambda place: has_cost_of(place, graph_with_gps(), Weighting.ISOTROPIC)
    ),
    Capability("landmarks", solves_landmarks),
    Capability(
        "rotations alone",
        lambda place: has_cost_of(place, graph_in_space(), Weighting.ROTATIONS),
    ),
    Capability("robust (GNC)", partial(finds_a_wrong_edge, solvers.GNC())),
    Capability("robust (PCM)", partial(finds_a_wrong_edge, solvers.PCM())),
    Capability("covariances", has_covariances),
    Capability("handedness terms", certifies_by_terms),
    Capability("rotations as complex numbers", certifies_in_complex_numbers),
    Capability("a start that grows", grows),
    Capability("checkpoints", writes_checkpoints),
    Capability("`extend`", extends),
    Capability("faults", bears_faults),
    Capability("CONSENSUS", runs_soc(lambda: consensus(graph_in_space()))),
    Capability(
        "SUBSTRUCTURED", runs_soc(lambda: solvers.SOC(coupling=solvers.Coupling.SUBSTRUCTURED))
    ),
    Capability("`PaperSOC`", runs_soc(solvers.PaperSOC)),
)


def tried(capability: Capability, place: Place) -> str:
    """What the table says of a cell: that it works, that it is missing, or why it is refused."""
    try:
        return WORKS if capability.works(place) else ""
    except PGOError as error:
        return str(error)


def table() -> str:
    """The table of the page."""
    rows = [["", *(place.name for place in PLACES)], ["---"] * (1 + len(PLACES))]
    for capability in CAPABILITIES:
        cells = (tried(capability, place) for place in PLACES)
        rows.append([capability.name, *(WORKS if cell == WORKS else MISSING for cell in cells)])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def cells_of_page() -> dict[tuple[str, str], str]:
    """What the page says of every capability and place."""
    lines = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line[:1] == "|"]
    head, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert head == ["", *(place.name for place in PLACES)]
    return {
        (name, place): cell
        for name, *cells in rows
        for place, cell in zip(head[1:], cells, strict=True)
    }


@pytest.mark.parametrize("place", PLACES, ids=lambda place: place.name)
@pytest.mark.parametrize("capability", CAPABILITIES, ids=lambda capability: capability.name)
def test_a_cell_of_the_table_works_or_is_refused_in_a_sentence(
    capability: Capability, place: Place
) -> None:
    result = tried(capability, place)
    says = cells_of_page()[capability.name, place.name]
    assert says == (WORKS if result == WORKS else MISSING), result
    assert result == WORKS or (len(result.split()) > 4 and "\n" not in result)


if __name__ == "__main__":
    print(table())
