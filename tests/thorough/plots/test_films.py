"""Films: what their frames draw, how large they are, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models.errors import GraphError, SettingError
from pgo_models.plots.films import MOST_BYTES, MOST_FRAMES
from pgo_models.plots.pages import save_page

pytest.importorskip("plotly")


def drawn(trace) -> np.ndarray:
    """Points of a trace, (k, d), with nan for a gap."""
    names = "xyz" if trace.type == "scatter3d" else "xy"
    return np.array([trace[name] for name in names], dtype=float).T


def lines_of(trace) -> set[tuple[tuple[float, ...], ...]]:
    """Lines that a trace draws, each from the lesser of its ends."""
    points = drawn(trace)
    pairs = np.stack([points[:-1], points[1:]], axis=1)
    pairs = pairs[np.isfinite(pairs).all(axis=(1, 2))]
    return {tuple(sorted(map(tuple, pair.tolist()))) for pair in pairs}


@pytest.mark.parametrize("d", [2, 3])
def test_a_frame_draws_every_edge_at_the_poses_of_its_iterate(d: int) -> None:
    graph = pgo.random_geometric(30, np.random.default_rng(0), d=d)
    iterates = [pgo.spanning_tree_start(graph, root) for root in range(4)]
    film = pgo.animate_poses(graph, iterates)
    assert [frame.name for frame in film.frames] == ["k = 0", "k = 1", "k = 2", "k = 3"]
    (slider,) = film.layout.sliders
    assert [list(step.args[0]) for step in slider.steps] == [[frame.name] for frame in film.frames]
    extent = np.ptp(np.concatenate([poses.t for poses in iterates]), axis=0).max()
    for frame, poses in zip(film.frames, iterates, strict=True):
        t = poses.aligned_to(iterates[-1]).t
        found = np.array(sorted(lines_of(frame.data[0])))
        expected = np.array(
            sorted(
                tuple(sorted(map(tuple, t[[i, j]]))) for i, j in zip(graph.i, graph.j, strict=True)
            )
        )
        assert len(found) == graph.num_edges
        # Ends that are nearly equal in x may change places when they are rounded.
        np.testing.assert_allclose(
            np.sort(found.mean(axis=1), axis=0),
            np.sort(expected.mean(axis=1), axis=0),
            rtol=0,
            atol=2e-3 * extent,
        )


def test_films_of_large_graphs_stay_small_and_keep_their_paths_and_ends() -> None:
    graph = pgo.grid_world(2, 3000, np.random.default_rng(0), d=3)
    film = pgo.animate_poses(graph, [graph.truth] * 60)
    assert (film.frames[0].name, film.frames[-1].name) == ("k = 0", "k = 59")
    assert len(film.frames) <= MOST_FRAMES
    assert len(film.to_json()) <= MOST_BYTES
    for robot, trace in enumerate(film.frames[0].data[:2]):
        own = graph.truth.t[graph.robots == robot]
        path = drawn(trace)
        np.testing.assert_allclose(path[0], own[0], rtol=0, atol=0.1)
        assert len(path) > 100


@pytest.mark.parametrize(
    ("iterates", "labels", "message"),
    [(0, None, "no iterates"), (2, ["one"], "1 labels for 2 iterates")],
)
def test_films_of_nothing_are_refused(
    iterates: int, labels: list[str] | None, message: str
) -> None:
    graph = pgo.circle(np.random.default_rng(0))
    with pytest.raises(GraphError, match=message):
        pgo.animate_poses(graph, [graph.truth] * iterates, labels)


POINT = {"x": [0.0], "y": [0.0]}


@pytest.mark.parametrize(
    ("frames", "labels", "message"),
    [
        ([], [], "no frames"),
        ([[POINT], [POINT]], ["a"], "1 labels for 2 frames"),
        ([[POINT], [POINT]], ["a", "a"], "the same label"),
        ([[POINT], [POINT, POINT]], ["a", "b"], "1 to 2 traces"),
        ([[{"x": list(range(100_000))}]] * 2, ["a", "b"], "show at most 0 of them, or less in"),
    ],
)
def test_pictures_that_make_no_film_are_refused(frames, labels, message) -> None:
    with pytest.raises(SettingError, match=message):
        pgo.animate(frames, labels)


def test_a_film_of_methods_shows_cost_and_bound_closing_in() -> None:
    graph = pgo.load("grid")
    film = solvers.film(graph)
    assert len(film.to_json()) <= MOST_BYTES
    methods = [frame.name.partition(" ")[0].rstrip(":") for frame in film.frames]
    assert methods == sorted(methods, key=["start", "SOC", "Newton"].index)
    above, below = (np.array(trace.y) for trace in film.data[:2])
    assert above[0] > 1.0  # the first cost is more than twice the least
    assert max(above[-1], below[-1]) < 1e-9
    assert (np.diff(below) <= 0.0).all()  # the best bound counts
    solution = solvers.solve(graph)
    description = film.layout.meta["description"]
    assert " falls from " in description
    assert f" to {solution.objective:.6g}, and the proven lower bound rises from " in description
    for k, frame in enumerate(film.frames):
        markers = [trace for trace in frame.data if trace.mode == "markers"]
        assert [(marker.x[0], marker.y[0]) for marker in markers] == [(k, above[k]), (k, below[k])]


def test_a_film_needs_methods_and_translations() -> None:
    graph = pgo.load("grid")
    with pytest.raises(SettingError, match="no methods"):
        solvers.film(graph, [])
    rotations = pgo.PGOProblem(graph, weighting=pgo.Weighting.ROTATIONS)
    with pytest.raises(SettingError, match="of rotations alone there are none"):
        solvers.film(rotations)


def test_a_page_says_in_words_what_a_film_shows(tmp_path) -> None:
    film = pgo.animate([[POINT], [POINT]], ["a", "b"], description="A point <stays>.")
    save_page(film, tmp_path / "film.html")
    assert "<title>" in (tmp_path / "film.html").read_text()
    text = (tmp_path / "film.html").read_text(encoding="utf-8")
    assert "<p>A point &lt;stays&gt;.</p>" in text
    assert json.dumps("A point <stays>.").replace("<", "\\u003c").replace(">", "\\u003e") in text
