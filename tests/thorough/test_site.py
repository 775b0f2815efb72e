"""The documentation builds without a warning, its links lead somewhere, and it works offline.

A browser opens and searches it from the disk.
"""

import inspect
import json
import os
import re
import runpy
import subprocess
import sys
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from browser import Browser

import pgo_models
import solvers

pytest.importorskip("myst_nb", reason="the extra docs")

ROOT = Path(__file__).parents[2]
BUILD = ROOT / "notebooks" / "site" / "build.py"
# What a page fetches by itself, as against what a reader may click on.
FETCHED = {"script": "src", "img": "src", "iframe": "src", "link": "href"}


class Page(HTMLParser):
    """Links, what is fetched, and the anchors of one page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: set[str] = set()
        self.fetched: set[str] = set()
        self.anchors: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        given = {name: value for name, value in attrs if value}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.add(given["href"])
        if tag in FETCHED and FETCHED[tag] in given:
            self.fetched.add(given[FETCHED[tag]])


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the pages: an earlier one if it is newer than all sources, or a new one."""
    built = BUILD.parent / "_build" / "html"
    sources = [
        path
        for folder in ("notebooks", "pgo_models", "solvers", "tests/benchmarks")
        for path in files(folder)
    ]
    newest = max(path.stat().st_mtime for path in [*sources, ROOT / "CHANGELOG.md"])
    if (built / "index.html").exists() and (built / "index.html").stat().st_mtime > newest:
        return built
    out = tmp_path_factory.mktemp("site")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ended = subprocess.run(
        [sys.executable, str(BUILD), "--out", str(out)],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    return out / "html"


def files(folder: str) -> list[Path]:
    return [
        path
        for kind in ("py", "md", "ipynb", "css", "js", "png")
        for path in (ROOT / folder).rglob(f"*.{kind}")
        if "_build" not in path.parts
    ]


@pytest.fixture(scope="module")
def pages(site):
    by_path = {
        path: Page(path) for path in sorted(site.rglob("*.html")) if "_static" not in path.parts
    }
    assert len(by_path) > 40
    return by_path


def test_every_link_within_the_site_leads_to_a_page_and_to_a_place_on_it(pages):
    lost = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme in ("http", "https", "mailto"):
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.exists() or (
                parts.fragment
                and target in pages
                and unquote(parts.fragment) not in pages[target].anchors
            ):
                lost.append(f"{path.name}: {link}")
    assert lost == []


def test_nothing_is_fetched_from_elsewhere(pages, site):
    for path, page in pages.items():
        for fetched in page.fetched:
            parts = urlsplit(fetched)
            assert parts.scheme in ("", "data"), f"{path.name} fetches {fetched}"
            if parts.path and not parts.scheme:
                assert (path.parent / unquote(parts.path)).exists(), (
                    f"{path.name}: {fetched} is not there"
                )
    for style in site.rglob("*.css"):
        assert not re.search(
            r"(?:url\(|@import\s+)[\"']?(?:https?:)?//", style.read_text(encoding="utf-8")
        ), style.name


def test_the_reference_has_every_public_name_and_every_notebook_is_there(pages, site):
    anchors = set().union(*(page.anchors for page in pages.values()))
    for package in (pgo_models, solvers):
        for name in package.__all__:
            thing = inspect.unwrap(getattr(package, name))
            assert f"{thing.__module__}.{thing.__qualname__}" in anchors, name
    for notebook in (ROOT / "notebooks").glob("[0-9][0-9]_*.py"):
        assert site / "notebooks" / f"{notebook.stem}.html" in pages


ENTRY = re.compile(
    r'<dl class="py (property|method|function)">\s*<dt[^>]*id="([^"]+)">(.*?)</dt>', re.S
)


def test_every_property_and_function_of_the_reference_has_its_type_in_the_projects_words(site):
    counts = dict.fromkeys(("property", "method", "function"), 0)
    for page in (site / "reference").glob("*.html"):
        for kind, name, head in ENTRY.findall(page.read_text(encoding="utf-8")):
            counts[kind] += 1
            text = " ".join(unescape(re.sub("<[^>]+>", "", head)).split())
            assert re.search(r": \w" if kind == "property" else "\N{RIGHTWARDS ARROW}", text), name
            assert "ndarray[" not in text, f"{name}: {text}"
    assert min(counts.values()) > 100


def opened_without_complaint(browser: Browser) -> None:
    assert browser.errors == []
    assert [
        request
        for request in browser.requests
        if not request.startswith(("file:", "data:", "about:"))
    ] == []


def test_a_browser_searches_it_from_the_disk(browser, site):
    browser.open(site / "index.html")
    browser.wait_for("document.readyState === 'complete'")
    browser.value("setTimeout(() => { location.href = 'search.html?q=grounded' })")
    results = "[...document.querySelectorAll('#search-results li a')]"
    result = f"{results}.find(a => a.textContent === 'What is proved')"
    browser.wait_for(f"{result} !== undefined")
    target = browser.value(f"{result}.href")
    assert target.startswith((site / "proved.html").as_uri())
    opened_without_complaint(browser)
    browser.value(f"setTimeout(() => {result}.click())")
    browser.wait_for("document.querySelector('h1')?.textContent.startsWith('What is proved')")


@pytest.mark.parametrize("query", ["penalty", "rotation", "ledger"])
def test_a_search_lists_guide_and_notebooks_before_the_reference(query, browser, site):
    browser.open(site / "index.html")
    browser.value(f"setTimeout(() => {{ location.href = 'search.html?q={query}' }})")
    results = "[...document.querySelectorAll('#search-results li a')]"
    browser.wait_for(f"{results}.some(a => a.href.includes('/reference/'))")
    browser.wait_for("/found/.test(document.querySelector('.search-summary')?.textContent)")
    links = browser.value(f"{results}.map(a => a.href)")
    # The site itself may be in a folder of such a name.
    pages = [link.removeprefix(site.as_uri()) for link in links]
    found = [re.match("/(guide|notebooks|reference)/", page) for page in pages]
    places = {"guide": 0, "notebooks": 0, "reference": 2}
    ranks = [places[match[1]] if match else 1 for match in found]
    assert ranks == sorted(ranks)
    assert {0, 2} <= set(ranks)


# The figure, as far as it is drawn, and what the line that is read out says of it.
FILM = "document.querySelector('.plotly-graph-div')"
PICTURE = f"JSON.stringify({FILM}._fullData.map(d => [d.x, d.y]))"
STATUS = "document.querySelector('.film-status').textContent"


@pytest.mark.parametrize("width", [390, 768, 1280, 1920])
def test_a_film_of_a_notebook_is_seen_and_moves_by_a_key(width, browser, site):
    with browser.showing(width, "light"):
        browser.open(site / "notebooks" / "01_quickstart.html")
        browser.wait_for("document.querySelector('.plotly-graph-div .slider-rail-rect') !== null")
        films = browser.value("document.querySelectorAll('.plotly-graph-div').length")
        assert films == browser.value("document.querySelectorAll('.film-status').length") > 0
        # One script serves all films of a page, and the page does not scroll sideways.
        assert browser.value("document.querySelectorAll('script[src*=plotly]').length") == 1
        assert browser.value("document.documentElement.scrollWidth <= innerWidth")
        left, right, height = browser.value(
            "(b => [b.left, b.right, b.height])"
            "(document.querySelector('.plotly-graph-div').getBoundingClientRect())"
        )
        assert 0 <= left < right <= width
        assert height > 200
        # Plotly draws before the page is laid out, and then follows the column.
        drawn = f"{FILM}.querySelector('.main-svg').clientWidth"
        browser.wait_for(f"{drawn} === {FILM}.clientWidth")
        first = browser.value(PICTURE)
        browser.value(f"{FILM}.focus()")
        browser.press("End", "End", 35)
        browser.wait_for(f"{STATUS} !== ''")
        browser.wait_for(f"{PICTURE} !== {json.dumps(first)}")
        slider = f"{FILM}._fullLayout.sliders[0]"
        assert browser.value(f"{slider}.active === {slider}.steps.length - 1")
        browser.press(" ", "Space", 32)  # play
        browser.press(" ", "Space", 32)  # stop
        browser.value("new Promise(done => setTimeout(done, 500))")
        opened_without_complaint(browser)


# What of a page reaches beyond its column, and is not in a box that scrolls.
TOO_WIDE = """
(() => {
  const column = document.querySelector('.bd-article');
  const limit = column.getBoundingClientRect().right + 1;
  const ends = (element) => element.getBoundingClientRect().right;
  const scrolls = (element) => getComputedStyle(element).overflowX !== 'visible';
  return [...column.querySelectorAll('*')].filter((element) => {
    if (ends(element) <= limit || element.getBoundingClientRect().width === 0) { return false; }
    for (let box = element.parentElement; box !== column.parentElement; box = box.parentElement) {
      if (scrolls(box) && ends(box) <= limit) { return false; }
    }
    return true;
  }).map((element) => `${element.tagName} ${element.textContent.slice(0, 60)}`);
})()
"""


# Formulas that are wider than their column, of which one has to scroll to see the end.
CUT_OFF = """
[...document.querySelectorAll('mjx-container[display=true]')]
  .filter((formula) => formula.scrollWidth > formula.clientWidth + 1)
  .map((formula) => formula.closest('section').id)
"""


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 768, 1280, 1920])
def test_nothing_on_a_page_is_wider_than_its_column(width, browser, site):
    pages = [site / "index.html", site / "notebooks.html", site / "proved.html"]
    wide = {}
    with browser.showing(width, "light"):
        for page in [*pages, *sorted(site.glob("guide/*.html")), *site.glob("notebooks/*.html")]:
            browser.open(page)
            count = browser.value("document.querySelectorAll('.math').length")
            browser.wait_for(f"document.querySelectorAll('.math mjx-container').length >= {count}")
            films = "[...document.querySelectorAll('.plotly-graph-div')]"
            browser.wait_for(
                f"{films}.every(f => f.querySelector('.main-svg')?.clientWidth === f.clientWidth)"
            )
            found = browser.value(TOO_WIDE) + (browser.value(CUT_OFF) if width >= 1280 else [])
            if found or browser.value("document.documentElement.scrollWidth > innerWidth"):
                wide[page.name] = found[:3]
    assert wide == {}


def test_the_front_page_opens_on_a_film_that_moves(browser, site):
    browser.open(site / "index.html")
    browser.wait_for(f"{FILM}?._fullLayout?.sliders !== undefined")
    first = browser.value(PICTURE)
    browser.value(f"{FILM}.focus()")
    browser.press("End", "End", 35)
    browser.wait_for(f"{PICTURE} !== {json.dumps(first)}")
    opened_without_complaint(browser)


def test_results_of_a_search_show_where_the_word_stands(browser, site):
    browser.open(site / "index.html")
    browser.value("setTimeout(() => { location.href = 'search.html?q=grounded' })")
    item = "#search-results li:has(a[href*='proved.html'])"
    browser.wait_for(f'document.querySelector("{item} .excerpt") !== null')
    shown = browser.value(f'document.querySelector("{item} .excerpt").textContent')
    assert "grounded" in shown.lower()
    assert 50 < len(shown) < 400


def test_pictures_lead_to_notebooks_and_to_lines_of_the_gallery(site):
    index = (site / "notebooks.html").read_text(encoding="utf-8")
    for notebook in (ROOT / "notebooks").glob("[0-9][0-9]_*.py"):
        link = rf'<a [^>]*href="notebooks/{notebook.stem}\.html"[^>]*>(<span[^>]*>)?<img'
        assert re.search(link, index), notebook.stem
    gallery = (site / "guide" / "gallery.html").read_text(encoding="utf-8")
    sections = re.findall(
        r"^### ", (BUILD.parent / "guide" / "gallery.md").read_text("utf-8"), re.M
    )
    thumbnails = re.findall(r'<a [^>]*href="#[\w-]+"[^>]*><img', gallery)
    assert len(thumbnails) == len(sections)
    assert gallery.count("Used in") > 5


def test_the_method_is_on_one_page_of_pdf(pages, site):
    for page in ("index.html", "guide/teach.html"):
        (link,) = [link for link in pages[site / page].links if link.endswith("method.pdf")]
        content = ((site / page).parent / link).read_bytes()
        assert content.startswith(b"%PDF")
        assert content.count(b"/Type /Page\n") + content.count(b"/Type /Page ") == 1


@pytest.mark.parametrize(
    "page",
    ["proved.html", "notebooks/01_quickstart.html", "reference/pgo_models.certificates.html"],
)
def test_a_browser_shows_formulas_and_pictures_without_a_complaint(page, browser, site):
    browser.open(site / page)
    browser.wait_for("document.querySelectorAll('mjx-container svg').length > 10")
    wrong = "document.querySelectorAll('mjx-merror, [data-mjx-error]').length"
    assert browser.value(wrong) == 0
    assert (
        browser.value(
            "[...document.images].filter(i => !i.complete || i.naturalWidth === 0).length"
        )
        == 0
    )
    assert browser.value("document.querySelector('h1').textContent.length") > 0
    opened_without_complaint(browser)


@pytest.mark.slow
def test_all_formulas_of_the_reference_are_typeset(browser, site):
    wrong = "[...document.querySelectorAll('[data-mjx-error]')].map(e => e.dataset.mjxError)"
    for page in sorted((site / "reference").glob("*.html")):
        browser.open(page)
        count = browser.value("document.querySelectorAll('.math').length")
        browser.wait_for(f"document.querySelectorAll('.math mjx-container').length >= {count}")
        assert browser.value(wrong) == [], page.name


BUILDER = runpy.run_path(str(BUILD))
PYPROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def test_notebooks_are_run_by_a_link_once_the_repository_has_an_address(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(BUILD.parent))
    without_urls = re.sub(r"^\[project\.urls\]$.*?(?=^\[)", "", PYPROJECT, flags=re.M | re.S)
    urls = '[project.urls]\nRepository = "https://example.org/some/name"\n'
    for text, has_address in ((without_urls, False), (without_urls + urls, True)):
        source = tmp_path / str(has_address)
        BUILDER["assemble"](source, BUILDER["repository_address"](text))
        index = (source / "notebooks.md").read_text(encoding="utf-8")
        assert ("Without installing" in index) == has_address
        for notebook in (source / "notebooks").glob("*.ipynb"):
            text = "".join(json.loads(notebook.read_text("utf-8"))["cells"][0]["source"])
            links = re.findall(r"\]\((https://mybinder[^)]+)\)", text)
            address = "git/https%3A%2F%2Fexample.org%2Fsome%2Fname/HEAD"
            path = f"?labpath=notebooks%2F{notebook.name}"
            assert links == [f"https://mybinder.org/v2/{address}{path}"] * has_address


FORMULAS = runpy.run_path(str(ROOT / "notebooks" / "site" / "formulas.py"))


@pytest.mark.parametrize(
    ("block", "tex"),
    [
        ("x_a <- x_a + alpha H_aa^-1 (b - H x)_a",
         r"x_{a} \leftarrow x_{a} + \alpha H_{aa}^{-1} (b - H x)_{a}"),
        ("sum_e kappa ||R_j - R_i R_ij||_F^2 >= 0",
         r"\sum_{e} \kappa \lVert R_{j} - R_{i} R_{ij} \rVert_{F}^{2} \ge 0"),
        ("tr(X'^T S X') <= tr(G_r^T S_r^-1 G_r)",
         r"\operatorname{tr} (X^{\prime T} S X^{\prime}) \le"
         r" \operatorname{tr} (G_{r}^{T} S_{r}^{-1} G_{r})"),
        ("P^_i = <p^k, x> + |v|^T v + s^1/2 + r^2/2",
         r"\hat{P}_{i} = \langle p^{k} , x \rangle + \lvert v \rvert^{T} v + s^{1/2} + r^{2} / 2"),
        ("J = [I, -T; 0, I],    hat(w) t_j = -T w",
         r"J = \begin{bmatrix} I & - T \\ 0 & I \end{bmatrix} , \qquad \hat{w} t_{j} = - T w"),
        ("x^{k+1} = argmin over x of L_alpha(lam^k)",
         r"x^{k + 1} = \operatorname{argmin} \text{ over } x \text{ of } L_{\alpha} (\lambda^{k})"),
        ("w = relative_error K_II,a^-T + sqrt(gamma_(c_j))",
         r"w = \mathtt{relative\_error}\, K_{II,a}^{-T} + \sqrt{\gamma_{c_{j}}}"),
    ],
)  # fmt: skip
def test_an_indented_formula_becomes_tex(block, tex):
    assert FORMULAS["display"](["    " + block]) == tex


@pytest.mark.parametrize(
    "block",
    [
        "pgo solve mine.g2o --out solved.g2o",
        "g2o file -> PoseGraph -> PGOProblem -> Certificate -> report",
        "t_i:  tau          t_j: -tau     R_i: tau t_ij^T",  # a table
        "F            585.0700055",
        "minimise J(X, y) over the convex constraints, with X in a set of rotations",
        "x = (a_i + b_i",  # has no end
        "a_i = b_i % 2",
        "w = a_i x b_i x c",  # a vector product, or factors
    ],
)
def test_what_is_no_formula_stays_as_it_is_written(block):
    assert FORMULAS["display"](["    " + block]) is None


@pytest.mark.parametrize(
    ("prose", "shown"),
    [
        ("poses x_i = (R_i, t_i) in SE(d).", "poses [x_{i} = (R_{i} , t_{i})] in SE(d)."),
        ("A pose of F, and a graph.", "A pose of [F], and a graph."),
        ("A solution of A x = b, A being", "A solution of [A x = b], A being"),
        ("I of shape (n, d, d) or (m,)", "I of shape [(n , d , d)] or [(m ,)]"),
        ("R^T R = I and ||w|| <= pi.", "[R^{T} R = I] and [\\lVert w \\rVert \\le \\pi]."),
        ("a radius of 2.6 m in the x-y plane", "a radius of 2.6 m in the x-y plane"),
        ("the R-step (a), e.g. of num_poses", "the R-step (a), e.g. of num_poses"),
        ("the log of a robot log (JRL)", "the log of a robot log (JRL)"),
        ("D. Rosen and M. Deghat, 2.", "D. Rosen and M. Deghat, 2."),
        ("x y z and w x v", "x y z and w x v"),
        ("max_iterations = 3, rho=2", "max_iterations = 3, rho=2"),
        ("the 3 x 4 matrix, a d x d block", "the [3 \\times 4] matrix, a [d \\times d] block"),
        ("a gap of 1e-6, or of 5 %", "a gap of 1e-6, or of 5 %"),
        ("it is -h_1 (see F (3))", "it is [- h_{1}] (see [F] (3))"),
        ("the sum sum_rows kappa", "the sum [\\sum_{\\mathrm{rows}} \\kappa]"),
        ("kappa and tau, Z* and X^", "[\\kappa] and [\\tau], [Z^{*}] and [\\hat{X}]"),
    ],
)  # fmt: skip
def test_formulas_are_found_in_prose_and_words_are_not(prose, shown):
    pieces = FORMULAS["inline"](prose)
    assert "".join(f"[{text}]" if is_tex else text for text, is_tex in pieces) == shown
