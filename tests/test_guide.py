"""The pages of the documentation: they show what is printed, and the notebooks and files they name are there."""

import doctest
import re
import shlex
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SITE = ROOT / "notebooks" / "site"
PAGES = [*sorted(SITE.glob("guide/*.md")), SITE / "proved.md"]
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
BLOCK = re.compile(r"^```(console|python)\n(.*?)^```$", re.M | re.S)

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


def test_there_is_a_page_for_every_task():
    assert {page.stem for page in PAGES} >= {"my_file", "certify", "outliers", "robots", "change_the_model", "teach"}


@each_page
def test_a_page_shows_what_is_printed(page, pgo_command, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PGO_DATA", raising=False)
    names: dict[str, object] = {}
    checker, report = doctest.OutputChecker(), []
    runner = doctest.DocTestRunner(optionflags=FLAGS, verbose=False)
    for kind, text in BLOCK.findall(page.read_text(encoding="utf-8")):
        if kind == "python":
            test = doctest.DocTestParser().get_doctest(text, names, page.stem, str(page), 0)
            runner.run(test, out=report.append, clear_globs=False)
            names = test.globs
            continue
        command, _, expected = text.removeprefix("$ ").partition("\n")
        words = shlex.split(command.replace(" data/", f" {ROOT}/data/"))
        assert words[0] == "pgo"
        _, out, err = pgo_command(*words[1:])
        assert checker.check_output(expected, out, FLAGS), f"{command}\n{out}\n{err}"
    assert report == []


@each_page
def test_what_a_page_links_to_is_there(page):
    text = page.read_text(encoding="utf-8")
    assert text.isascii()
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        if not target.startswith("http"):
            path = (page.parent / target).resolve()
            at_home = ROOT / "notebooks" / path.name if path.suffix == ".ipynb" else path
            made = {SITE / name for name in ("benchmarks.md", "changelog.md", "data.md")}
            assert at_home.exists() or path in made, target
    for path in re.findall(r"`((?:pgo_models|solvers|tests|notebooks|data)/[\w./-]+)`", text):
        assert (ROOT / path).exists(), path
