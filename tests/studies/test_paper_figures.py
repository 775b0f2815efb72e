import sys

import pytest

import pgo_models as pgo
from pgo_models.errors import MissingExtraError
from pgo_models.graphs.published_results import published_rows
from solvers import draw_paper_figures
from solvers.studies import paper_figures
from solvers.studies.paper_figures import FigureSet, explore_panels, plot_panels

pytest.importorskip("matplotlib")
pytest.importorskip("plotly")


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """All figures of the scenes alone, in a folder that was not there."""
    folder = tmp_path_factory.mktemp("figures") / "new"
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("PGO_DATA", raising=False)
        patch.chdir(folder.parent)
        patch.setattr("pooch.os_cache", lambda name: folder.parent / "cache")
        return folder, *draw_paper_figures(folder)


def test_there_is_a_picture_and_a_page_of_everything_that_is_here(drawn):
    folder, written, reasons = drawn
    names = ["scenes", "convergence-circle", "convergence-sphere", "convergence-grid"]
    assert [path.name for path in written] == [
        f"{name}{suffix}" for name in names for suffix in (".png", ".html")
    ]
    assert sorted(folder.iterdir()) == sorted(written)
    for path in written:
        assert (b"\x89PNG" if path.suffix == ".png" else b"<html") in path.read_bytes()[:100]
    assert [reason.split()[0] for reason in reasons] == ["parking-garage", "cubicle", "torus3D"]
    assert all("PGO_DATA" in reason for reason in reasons)


def test_pages_stay_on_the_machine(drawn):
    folder = drawn[0]
    for page in folder.glob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert 'src="http' not in text
        assert "Plotly.newPlot" in text


def test_truth_stands_above_the_result():
    shown = paper_figures._run(next(row for row in published_rows() if row.name == "grid"), False)
    titles = [title for title, _, _ in shown.panels]
    assert titles[0] == "grid, ground truth"
    assert titles[1].startswith("grid, SOC: F = 97.01")
    rows = [[panel] for panel in shown.panels]
    assert [axes.get_title() for axes in plot_panels(rows).axes] == titles
    page = explore_panels(rows)
    assert {trace.scene for trace in page.data} == {"scene", "scene2"}
    assert len({trace.name for trace in page.data if trace.showlegend}) == sum(
        bool(trace.showlegend) for trace in page.data
    )
    above = page.layout.scene.domain.y
    below = page.layout.scene2.domain.y
    assert above[0] > below[1]


def test_without_plotly_nothing_is_run(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "plotly", None)
    monkeypatch.setattr(paper_figures, "_run", lambda *_: pytest.fail("ran all the same"))
    with pytest.raises(MissingExtraError, match=r"plotly is not installed"):
        draw_paper_figures(tmp_path)


def test_what_is_drawn_before_an_interruption_is_there(monkeypatch, tmp_path):
    shown = paper_figures._run(next(row for row in published_rows() if row.name == "grid"), False)
    names = []

    def run(row, download):
        names.append(row.name)
        if len(names) == 5:
            raise KeyboardInterrupt
        return shown

    monkeypatch.setattr(paper_figures, "_run", run)
    with pytest.raises(KeyboardInterrupt):
        draw_paper_figures(tmp_path, (FigureSet.SCENES, FigureSet.BENCHMARKS))
    assert names == ["circle", "sphere", "grid", "parking-garage", "cubicle"]
    assert {path.name for path in tmp_path.iterdir()} == {"scenes.png", "scenes.html"}


def test_a_folder_that_cannot_be_made_is_said(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(pgo.PGOError, match="cannot make the folder"):
        draw_paper_figures(tmp_path / "file" / "folder", (FigureSet.SCENES,))
