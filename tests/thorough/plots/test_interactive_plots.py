import re
import sys

import numpy as np
import pytest

import pgo_models as pgo
from pgo_models.errors import MissingExtraError
from pgo_models.plots.pages import save_page

pytest.importorskip("plotly")


def ends(trace, d):
    """Start and end of every segment of a trace of edges, (edges, 2, d)."""
    points = np.stack([np.asarray(trace[letter]) for letter in "xyz"[:d]], axis=1).reshape(-1, 3, d)
    assert np.isnan(points[:, 2]).all()
    return points[:, :2]


@pytest.mark.parametrize("d", [2, 3])
def test_every_edge_and_pose_is_drawn_once(d):
    graph = pgo.grid_world(3, 10, np.random.default_rng(0), d=d)
    traces = pgo.explore_graph(graph, graph.truth).data
    drawn = np.concatenate([ends(trace, d) for trace in traces if trace.mode == "lines"])
    expected = np.stack([graph.truth.t[graph.i], graph.truth.t[graph.j]], axis=1)
    weights = np.random.default_rng(1).standard_normal(2 * d)  # tell segments apart in any order
    found, wanted = (
        np.sort(segments.reshape(-1, 2 * d) @ weights) for segments in (drawn, expected)
    )
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-5)
    named = [
        text
        for trace in traces
        if trace.mode == "markers" and trace.name != "misfit"
        for text in trace.text
    ]
    assert len(named) == len(set(named)) == graph.num_poses
    assert named[0] == "pose 0, robot 0"


def test_a_misfit_says_how_bad_it_is():
    graph = pgo.circle(np.random.default_rng(0))
    graph = graph.with_weights(np.where(np.arange(300) == 5, 1e3, 1.0) * graph.kappa, graph.tau)
    (misfit,) = [
        trace for trace in pgo.explore_graph(graph, graph.truth).data if trace.name == "misfit"
    ]
    residuals = pgo.edge_residuals(graph, graph.truth)
    assert len(misfit.text) == residuals.is_misfit.sum()
    (text,) = [text for text in misfit.text if text.startswith("edge 5:")]
    assert f"{np.rad2deg(residuals.rotation[5]):.3g} deg" in text


def test_a_page_escapes_its_title_and_has_no_button_that_uploads(tmp_path):
    graph = pgo.circle(np.random.default_rng(0))
    save_page(
        pgo.explore_graph(graph, graph.truth, "<script>alert(1)</script>"), tmp_path / "page.html"
    )
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert re.search(r'"showSendToCloud":\s*false', text)
    assert [file.name for file in tmp_path.iterdir()] == ["page.html"]


def test_without_plotly_one_line_names_the_extra(monkeypatch):
    graph = pgo.circle(np.random.default_rng(0))
    monkeypatch.setitem(sys.modules, "plotly", None)
    with pytest.raises(MissingExtraError, match=r"pgo-splitting\[plot\]"):
        pgo.explore_graph(graph, graph.truth)


@pytest.mark.parametrize("d", [2, 3])
def test_ellipses_of_covariances_are_one_trace(d):
    graph = pgo.random_geometric(150, np.random.default_rng(0), d=d)
    covariances = np.tile(np.diag(np.arange(1.0, 3 * d - 2)), (150, 1, 1))
    (*_, trace) = pgo.explore_graph(graph, graph.truth, covariances=covariances).data
    assert (trace.name, len(trace.x)) == ("95 % of x, y", 100 * 50)
    outlines = np.asarray(trace.x).reshape(100, 50)
    assert np.isnan(outlines[:, -1]).all()
    np.testing.assert_allclose(
        np.ptp(outlines[:, :-1], axis=1), 2 * np.sqrt(5.991464547107979), rtol=1e-5, atol=0
    )
