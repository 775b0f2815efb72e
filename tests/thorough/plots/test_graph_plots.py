import sys
from dataclasses import replace

import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models.errors import GraphError, MissingExtraError
from pgo_models.plots.curves import plot_decay, plot_tightness
from pgo_models.plots.graph_plots import (
    OWN,
    confidence_ellipses,
    draw_graph,
    edge_kinds,
    lines_to_draw,
    plot_against_truth,
    thinning_step,
)
from pgo_models.plots.matrix_plots import plot_spectrum
from pgo_models.plots.style import save_figure
from solvers.reporting.comparison_plots import plot_efforts
from solvers.reporting.convergence_plots import Curve

pytest.importorskip("matplotlib")


@pytest.mark.parametrize("d", [2, 3])
def test_every_edge_is_drawn_once_in_the_colour_of_its_robot(d):
    from matplotlib.figure import Figure

    graph = pgo.grid_world(3, 10, np.random.default_rng(0), d=d)
    axes = Figure().add_subplot(projection="3d" if d == 3 else None)
    draw_graph(graph, graph.truth, axes, mark_edges=False)
    (lines,) = axes.collections
    colours = lines.get_colors()
    drawn = [tuple(colour) for colour in np.asarray(colours)]
    grey = (0.6, 0.6, 0.6, 1.0)
    owner = np.where(graph.robots[graph.i] == graph.robots[graph.j], graph.robots[graph.i], 3)
    assert sorted(map(drawn.count, set(drawn) - {grey})) == sorted(np.bincount(owner)[:3])
    assert drawn.count(grey) == (owner == 3).sum()
    assert axes.get_xlabel() == "x (m)"


@pytest.mark.parametrize("d", [2, 3])
def test_doubtful_edges_stand_out(d):
    from matplotlib.colors import to_rgba
    from matplotlib.figure import Figure

    graph = pgo.grid_world(2, 12, np.random.default_rng(0), d=d)
    cost = pgo.edge_residuals(graph, graph.truth).cost
    wrong, unsure = np.argsort(cost)[:2]  # made to be what they are not
    kappa = graph.kappa.copy()
    tau = graph.tau.copy()
    tau[unsure] = 0.01 * tau[unsure]
    kappa[wrong] = 1e4 * kappa[wrong]
    marked = graph.with_weights(kappa, tau)
    assert pgo.edge_residuals(marked, graph.truth).is_misfit[wrong]
    axes = Figure().add_subplot(projection="3d" if d == 3 else None)
    draw_graph(marked, graph.truth, axes)
    (lines,) = axes.collections
    misfits = int(pgo.edge_residuals(marked, graph.truth).is_misfit.sum())
    widths = np.asarray(lines.get_linewidth())
    styles = lines.get_linestyle()
    assert (widths == widths.max()).sum() == misfits
    assert sum(pattern is not None for _, pattern in styles) == 1
    colours = [tuple(colour) for colour in np.asarray(lines.get_colors())]
    assert colours.count(to_rgba("#D55E00")) == misfits


def test_the_legend_says_only_what_is_there():
    graph = pgo.grid_world(3, 10, np.random.default_rng(0))
    (legend,) = pgo.plot_graph(graph, graph.truth).legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts[:3] == ["robot 0", "robot 1", "robot 2"]
    assert "between robots" in texts
    assert not any("uncertain" in text for text in texts)


@pytest.mark.parametrize("d", [2, 3])
def test_errors_to_the_truth_are_those_after_alignment(d):
    graph = pgo.grid_world(1, 12, np.random.default_rng(0), d=d)
    estimate = pgo.spanning_tree_start(graph)
    figure = plot_against_truth(graph, estimate)
    metres = figure.axes[1].lines[0].get_ydata()
    np.testing.assert_allclose(
        np.sqrt(np.mean(metres**2)),
        pgo.absolute_trajectory_error(estimate, graph.truth),
        rtol=1e-12,
        atol=0,
    )


def test_a_large_graph_is_drawn_as_paths_and_some_of_its_edges():
    graph = pgo.grid_world(3, 40, np.random.default_rng(0), d=2)
    kind = edge_kinds(graph, graph.truth)
    every = np.stack([graph.i, graph.j], axis=1)
    ends, kinds = lines_to_draw(graph, kind)
    assert sorted(map(tuple, ends)) == sorted(map(tuple, every))
    for most in (100, 20):
        ends, kinds = lines_to_draw(graph, kind, most)
        k = thinning_step(graph.num_edges, most)
        assert most / 2 < len(ends) <= most + 2 * graph.num_robots
        known = set(map(tuple, every))
        for (a, b), one in zip(ends, kinds, strict=True):
            steps = [(pose, pose + 1) for pose in range(a, b)]
            assert (a, b) in known or (
                one == OWN and b - a <= k and all(step in known for step in steps)
            )
    drawn = {pose for (a, b), one in zip(ends, kinds, strict=True) if one == OWN for pose in (a, b)}
    assert {0, 39, 40, 79, 80, 119} <= drawn  # every path has its ends


def test_a_solution_by_robots_shows_them_and_marks_misfits():
    graph = pgo.load("sphere")
    wrong = graph.t_ij + 30.0 * (np.arange(544) == 5)[:, None]
    solution = solvers.solve(replace(graph, t_ij=wrong), robots=3)
    assert solution.edge_residuals.is_misfit.any()
    (legend,) = solution.plot().legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts[:3] == ["robot 0", "robot 1", "robot 2"]
    assert any(text.startswith("misfit") for text in texts)


def test_without_a_truth_one_line_says_so():
    graph = pgo.grid_world(1, 12, np.random.default_rng(0))
    with pytest.raises(GraphError, match="without a ground truth"):
        plot_against_truth(replace(graph, truth=None), graph.truth)


def test_figures_are_a_column_wide_and_readable_there(tmp_path):
    graph = pgo.circle(np.random.default_rng(0))
    problem = pgo.PGOProblem(graph)
    solution = solvers.solve(problem)
    newton = solution.stages[-1]
    figures = [
        pgo.plot_graph(graph, graph.truth),
        plot_against_truth(graph, solution.poses),
        plot_spectrum(problem, solution.certificate),
        plot_decay([("half", 0.5 ** np.arange(5))], "error (m)"),
        plot_tightness([("circle", np.array([0.5, 1.0]), np.array([1.0, 0.5]))]),
        plot_efforts([Curve(newton.name, newton.history, solution.lower_bound)]),
    ]
    from matplotlib.text import Text

    for figure in figures:
        save_figure(figure, tmp_path / "figure.png")  # the texts are made when it is drawn
        assert figure.get_figwidth() == 3.4
        small = [
            text for text in figure.findobj(Text) if text.get_text() and text.get_fontsize() < 7
        ]
        assert not small


def test_poses_of_another_graph_are_refused():
    from matplotlib.figure import Figure

    graph = pgo.circle(np.random.default_rng(0))
    with pytest.raises(GraphError, match="one pose for every pose"):
        draw_graph(graph, pgo.Poses.identity(3, 3), Figure().add_subplot(projection="3d"))


def test_without_matplotlib_one_line_names_the_extra(monkeypatch):
    solution = solvers.solve(pgo.circle(np.random.default_rng(0)))
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match=r"pgo-splitting\[plot\]"):
        solution.plot()


@pytest.mark.parametrize("d", [2, 3])
def test_no_ellipse_is_cut_off(d):
    graph = pgo.grid_world(1, 30, np.random.default_rng(0), d=d)
    covariances = solvers.solve(graph).marginals()
    (axes,) = pgo.plot_graph(graph, graph.truth, covariances=covariances).axes
    outlines = confidence_ellipses(graph.truth, covariances)
    for letter, values in zip("xyz", outlines.reshape(-1, d).T, strict=False):
        lowest, highest = getattr(axes, f"get_{letter}lim")()
        rounding = 1e-12 * (highest - lowest)  # limits are a centre, less and plus a half
        assert lowest - rounding <= values.min() < values.max() <= highest + rounding


@pytest.mark.parametrize(("d", "poses"), [(2, 30), (3, 240)])
def test_ellipses_hold_what_their_covariance_says(d, poses):
    graph = pgo.random_geometric(poses, np.random.default_rng(0), d=d)
    A = np.random.default_rng(1).standard_normal((poses, 3 * d - 3, 3 * d - 3))
    covariances = A @ np.swapaxes(A, 1, 2)
    covariances[0] = 0.0
    outlines = confidence_ellipses(graph.truth, covariances)
    assert outlines.shape == (min(poses, 100), 49, d)
    chosen = [
        int(np.argmin(np.abs(graph.truth.t - middle).sum(axis=1)))
        for middle in outlines[:, :-1].mean(axis=1)
    ]
    assert chosen == sorted(set(chosen))
    assert (chosen[0], chosen[-1]) == (0, poses - 1)
    np.testing.assert_array_equal(outlines[0], np.tile(graph.truth.t[0], (49, 1)))
    for one, outline in zip(chosen[1:], outlines[1:], strict=True):
        away = outline - graph.truth.t[one]
        assert not away[:, 2:].any()
        square = np.sum(
            away[:, :2] * np.linalg.solve(covariances[one, :2, :2], away[:, :2].T).T, axis=1
        )
        # 95 % of chi2 with 2 degrees
        np.testing.assert_allclose(square, 5.991464547107979, rtol=1e-9, atol=0)
    figure = pgo.plot_graph(graph, graph.truth, covariances=covariances)
    (axes,) = figure.axes
    assert len(axes.collections) == 2
    assert [text.get_text() for text in figure.legends[0].get_texts()][-1] == "95 % of x, y"
