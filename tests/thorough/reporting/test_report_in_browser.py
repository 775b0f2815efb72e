import re
from dataclasses import replace

import numpy as np
import pytest
from pages import Page, own_part

import pgo_models as pgo
import solvers
from pgo_models.plots.pages import save_page

pytestmark = pytest.mark.slow  # clicks in a browser

pytest.importorskip("plotly")


def test_the_browser_hears_what_goes_wrong(browser, tmp_path):
    page = tmp_path / "wrong.html"
    page.write_text(
        "<img src='missing.png'><script>console.error('one'); throw Error('two')</script>"
    )
    browser.open(page)
    browser.wait_for("true")
    errors = " ".join(browser.errors)
    assert all(word in errors for word in ("one", "two", "missing.png"))
    assert (tmp_path / "missing.png").as_uri() in browser.requests


@pytest.mark.parametrize("which", ["solution", "uncertain", "plane"])
def test_a_browser_shows_it_without_a_complaint_and_sorts_the_table(
    which, browser, tmp_path, request
):
    if which == "plane":
        solved = solvers.solve(pgo.random_geometric(40, np.random.default_rng(0), d=2))
    else:
        solved = request.getfixturevalue(which)
    solvers.write_report(solved, tmp_path / "out.html")
    browser.open(tmp_path / "out.html")
    browser.wait_for("document.querySelectorAll('.plot .main-svg').length > 0")
    place = "graph2d" if which == "plane" else "graph3d"
    for plot in (place, "convergence"):
        browser.wait_for(f"document.getElementById('{plot}')._fullData?.length > 0")
        assert (
            browser.value(f"document.getElementById('{plot}').getBoundingClientRect().height") > 300
        )
    # WebGL has drawn: no message in its place.
    assert browser.value(f"document.querySelectorAll('#{place} canvas').length") > 0
    assert "WebGL is not supported" not in browser.value("document.body.innerText")
    column = browser.value(
        "[...document.querySelectorAll('#edges th')]"
        ".findIndex(head => head.innerText.startsWith('error (m)'))"
    )
    cells = (
        "[...document.querySelectorAll('#edges tbody tr')]"
        f".map(row => +row.cells[{column}].dataset.value)"
    )
    before = browser.value(cells)
    for descending in (True, False):
        browser.click(f"#edges th:nth-child({column + 1}) button")
        assert browser.value(cells) == sorted(before, reverse=descending)
    assert (
        browser.value("document.querySelector('#edges th[aria-sort]').getAttribute('aria-sort')")
        == "ascending"
    )
    assert browser.errors == []
    assert browser.requests == [(tmp_path / "out.html").as_uri()]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1150])
def test_it_fits_a_phone_and_follows_the_colours_of_the_system(
    width, scheme, browser, solution, tmp_path
):
    solvers.write_report(solution, tmp_path / "out.html")
    with browser.showing(width, scheme):
        browser.open(tmp_path / "out.html")
        browser.wait_for("document.querySelectorAll('.plot .main-svg').length > 0")
        assert browser.value("document.documentElement.scrollWidth") <= width
        edges = browser.value(
            "[...document.querySelectorAll('section, p, dd, code, .plot, .plot svg')]"
            ".map(one => one.getBoundingClientRect().right)"
        )
        assert max(edges) <= width
        ground, ink = (
            sum(
                map(
                    int,
                    re.findall(r"\d+", browser.value(f"getComputedStyle(document.body).{name}"))[
                        :3
                    ],
                )
            )
            for name in ("backgroundColor", "color")
        )
        assert (ground < ink) == (scheme == "dark")
        written = browser.value("document.getElementById('fit')._fullLayout.font.color")
        assert (written > "#888") == (scheme == "dark")
        assert browser.errors == []


def test_the_page_is_painted_before_the_library_is_parsed(browser, solution, tmp_path):
    solvers.write_report(solution, tmp_path / "out.html")
    browser.open(tmp_path / "out.html")
    browser.wait_for(
        "performance.getEntriesByName('library').length"
        " + performance.getEntriesByType('paint').length > 2"
    )
    # A frame is begun first, and the library is parsed in a task after it. When the screen shows
    # the frame depends on how busy the machine is.
    frame = browser.value("performance.getEntriesByName('frame')[0].startTime")
    assert frame <= browser.value("performance.getEntriesByName('library')[0].startTime")
    assert browser.value("performance.getEntriesByName('first-contentful-paint').length") == 1


def test_a_large_graph_is_thinned_and_its_page_can_be_opened(browser, solution, tmp_path):
    graph = pgo.grid_world(1, 44_521, np.random.default_rng(0), d=2)
    bounded = replace(solution, problem=pgo.PGOProblem(graph), all_poses=graph.truth)
    solvers.write_report(bounded, tmp_path / "out.html")
    assert (tmp_path / "out.html").stat().st_size < 15e6
    text = Page(own_part((tmp_path / "out.html").read_text(encoding="utf-8"))).text
    assert "paths through one of 3 poses, one of 3 other edges" in text
    browser.open(tmp_path / "out.html")
    browser.wait_for("document.getElementById('graph2d')._fullData?.length > 0")
    entries = browser.value(
        "document.getElementById('graph2d')._fullData"
        ".filter(trace => trace.showlegend).map(trace => trace.name)"
    )
    assert entries[:2] == ["before", "poses 0 to 7420"]
    assert browser.errors == []


def test_a_film_goes_by_slider_and_keys_in_a_browser(browser, tmp_path):
    graph = pgo.circle(np.random.default_rng(0))
    film = pgo.animate_poses(
        graph, [pgo.spanning_tree_start(graph), graph.truth, graph.truth], ["tree", "truth", "end"]
    )
    save_page(film, tmp_path / "film.html")
    browser.open(tmp_path / "film.html")
    browser.wait_for("document.querySelectorAll('.slider-group').length > 0")
    plot = "document.querySelector('.plotly-graph-div')"
    assert browser.value(f"{plot}._fullLayout.sliders[0].active") == 0
    assert "from tree to end" in browser.value(f"{plot}.getAttribute('aria-label')")

    browser.value(f"Plotly.animate({plot}, ['truth'], {{mode: 'immediate'}}).then(() => true)")
    browser.wait_for(f"{plot}._fullLayout.sliders[0].active === 1")
    shown = browser.value(f"Array.from({plot}._fullData[0].x).slice(0, 1)")[0]
    np.testing.assert_allclose(shown, graph.truth.t[0, 0], rtol=0, atol=1e-2)

    for key, place, label in (
        ("ArrowRight", 2, "end"),
        ("Home", 0, "tree"),
        ("ArrowLeft", 0, "tree"),
        ("End", 2, "end"),
    ):
        event = f"new KeyboardEvent('keydown', {{key: '{key}'}})"
        browser.value(f"{plot}.dispatchEvent({event})")
        browser.wait_for(f"{plot}._fullLayout.sliders[0].active === {place}")
        browser.wait_for(f"document.querySelector('.film-status').textContent === '{label}'")
    browser.value(f"{plot}.dispatchEvent(new KeyboardEvent('keydown', {{key: 'Home'}}))")
    browser.wait_for(f"{plot}._fullLayout.sliders[0].active === 0")
    browser.value(f"{plot}.dispatchEvent(new KeyboardEvent('keydown', {{key: ' '}}))")
    browser.wait_for(f"{plot}._fullLayout.sliders[0].active === 2")  # it plays to the end
    assert browser.errors == []


def test_a_film_fits_a_telephone(browser, tmp_path):
    save_page(solvers.film(pgo.load("grid")), tmp_path / "film.html")
    telephone = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.call("Emulation.setDeviceMetricsOverride", telephone)
    browser.open(tmp_path / "film.html")
    browser.wait_for("document.querySelectorAll('.slider-group').length > 0")
    assert browser.value("document.documentElement.scrollWidth") <= 390
    browser.call("Emulation.clearDeviceMetricsOverride", {})
    assert browser.errors == []
