import builtins

import numpy as np
import pytest

import pgo_models as pgo
import solvers

pytest.importorskip("matplotlib")


@pytest.mark.parametrize("d", [2, 3])
def test_every_edge_is_drawn_once_in_the_colour_of_its_robot(d):
    from matplotlib.figure import Figure

    graph = pgo.grid_world(3, 10, np.random.default_rng(0), d=d)
    axes = Figure().add_subplot(projection="3d" if d == 3 else None)
    pgo.draw_graph(graph, graph.truth, axes)
    (lines,) = axes.collections
    colours = lines.get_colors() if d == 2 else lines._colors3d if hasattr(lines, "_colors3d") else lines.get_colors()
    assert len(colours) == graph.num_edges
    same = graph.robots[graph.i] == graph.robots[graph.j]
    assert len({tuple(colour) for colour in np.asarray(colours)[same]}) == 3
    assert {tuple(colour) for colour in np.asarray(colours)[~same]} <= {(0.6, 0.6, 0.6, 1.0)}
    assert axes.get_xlabel() == "x (m)"


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_a_solution_saves_its_picture(suffix, tmp_path):
    path = tmp_path / f"picture{suffix}"
    solvers.solve(pgo.circle(np.random.default_rng(0))).save(path)
    head = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}[suffix]
    assert path.read_bytes().startswith(head)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_poses_of_another_graph_are_refused():
    from matplotlib.figure import Figure

    graph = pgo.circle(np.random.default_rng(0))
    with pytest.raises(pgo.GraphError, match="one pose for every pose"):
        pgo.draw_graph(graph, pgo.Poses.identity(3, 3), Figure().add_subplot(projection="3d"))


def test_without_matplotlib_one_line_names_the_extra(monkeypatch):
    real = builtins.__import__

    def without(name, *rest):
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *rest)

    solution = solvers.solve(pgo.circle(np.random.default_rng(0)))
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(pgo.MissingExtraError, match=r"pgo-splitting\[plot\]"):
        solution.plot()
