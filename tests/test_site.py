"""The documentation builds without a warning, its links lead somewhere, and it works offline.

A browser opens and searches it from the disk.
"""

import os
import re
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

ROOT = Path(__file__).parent.parent
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
        for kind in ("py", "md", "ipynb", "css")
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
            thing = getattr(package, name)
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


@pytest.mark.parametrize(
    "page",
    ["proved.html", "notebooks/01_quickstart.html", "reference/pgo_models.certificates.html"],
)
def test_a_browser_shows_formulas_and_pictures_without_a_complaint(page, browser, site):
    browser.open(site / page)
    if "reference" not in page:
        browser.wait_for("document.querySelectorAll('mjx-container svg').length > 10")
        assert (
            browser.value("document.querySelectorAll('mjx-merror, [data-mjx-error]').length") == 0
        )
    assert (
        browser.value(
            "[...document.images].filter(i => !i.complete || i.naturalWidth === 0).length"
        )
        == 0
    )
    assert browser.value("document.querySelector('h1').textContent.length") > 0
    opened_without_complaint(browser)
