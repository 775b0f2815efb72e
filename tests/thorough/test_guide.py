"""The pages of the documentation show what is printed, and link to what exists.

Their commands and examples are run; links, files and options of commands are looked up.
"""

import doctest
import re
import runpy
import shlex
from pathlib import Path

import pytest
import typer

from solvers.cli import app as cli, options as cli_options
from solvers.cli.robot_command import MethodOfTeam

ROOT = Path(__file__).parents[2]
SITE = ROOT / "notebooks" / "site"
PAGES = [*sorted(SITE.glob("guide/*.md")), SITE / "proved.md"]
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
BLOCK = re.compile(r"^```(console|python)\n(.*?)^```$", re.M | re.S)


each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


def test_every_page_of_the_guide_is_in_its_index_with_its_title_and_a_question():
    index = (SITE / "guide" / "index.md").read_text(encoding="utf-8")
    order = [name for name in re.findall(r"^\w+$", index, re.M) if name != "Guide"]
    rows = re.findall(r"^\| \[(.+?)\]\((\w+)\.md\) \| .+\? \|$", index, re.M)
    assert [name for _, name in rows] == order
    assert set(order) == {page.stem for page in SITE.glob("guide/*.md")} - {"index"}
    for title, name in rows:
        page = (SITE / "guide" / f"{name}.md").read_text(encoding="utf-8")
        assert page.startswith(f"# {title}\n")


@pytest.mark.slow
@each_page
def test_a_page_shows_what_is_printed(page, pgo_command, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PGO_DATA", raising=False)
    names: dict[str, object] = {}
    checker = doctest.OutputChecker()
    report = []
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


BUILD = runpy.run_path(str(SITE / "build.py"))  # the script is not run


def assert_links_lead_somewhere(page: Path, text: str) -> None:
    """Check the links of a page of the site, into which notebooks and pictures are copied."""
    pictures = SITE / "notebooks" / "pictures"
    copied = (SITE / "notebooks", pictures, pictures / "gallery")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        if target.startswith("http"):
            continue
        path = (page.parent / target).resolve()
        assert path.is_relative_to(SITE), target
        at_home = ROOT / path.relative_to(SITE) if path.parent in copied else path
        assert at_home.exists() or path.name in BUILD["PAGES"].values(), target


@pytest.mark.parametrize("page", sorted(SITE.glob("*.md")), ids=lambda page: page.stem)
def test_what_a_page_around_the_guide_links_to_is_there(page):
    assert_links_lead_somewhere(page, page.read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", BUILD["PAGES"])
def test_what_a_page_of_the_repository_links_to_is_on_the_site(page):
    text = BUILD["relinked"]((ROOT / page).read_text(encoding="utf-8"), page)
    assert_links_lead_somewhere(SITE / BUILD["PAGES"][page], text)


@each_page
def test_what_a_page_links_to_is_there(page):
    text = page.read_text(encoding="utf-8")
    assert text.isascii()
    assert_links_lead_somewhere(page, text)
    for path in re.findall(r"`((?:pgo_models|solvers|tests|notebooks|data)/[\w./-]+)`", text):
        assert (ROOT / path).exists(), path


COMMANDS = typer.main.get_command(cli.app).commands
CHOICES = {
    "--method": cli_options.FirstStage,
    "--split": cli_options.Split,
    "--engine": cli_options.Runner,
    "--start": cli_options.Start,
    "--robust": cli_options.Robust,
}
CHOICES_OF_COMMANDS = {("robot", "--method"): MethodOfTeam}


def section_of(command: str) -> str:
    page = (SITE / "guide" / "commands.md").read_text(encoding="utf-8")
    return re.search(rf"^## pgo {command}\n(.*?)(?=^## |\Z)", page, re.M | re.S)[1]


def shown_options(command: str) -> dict[str, tuple[set[str], str]]:
    """All names of every option of a command, and its effect, by its long name."""
    shown = {}
    for names, effect in re.findall(r"^\| (`-.*?) \| (.*) \|$", section_of(command), re.M):
        words = [re.split("[ `]", name)[1] for name in names.split(", ")]
        shown[words[0]] = (set(words), effect)
    return shown


@pytest.mark.parametrize("name", COMMANDS)
def test_the_page_of_the_command_line_has_every_option_with_its_choices(name):
    shown = shown_options(name)
    options = [one for one in COMMANDS[name].params if one.opts[0].startswith("-")]
    assert sorted(shown) == sorted(option.opts[0] for option in options)
    for option in options:
        names, effect = shown[option.opts[0]]
        assert names == set(option.opts)
        of_all = CHOICES.get(option.opts[0], ())
        for choice in CHOICES_OF_COMMANDS.get((name, option.opts[0]), of_all):
            assert f"`{choice.value}`" in effect, f"{option.opts[0]} {choice.value}"


def test_the_page_of_the_command_line_has_every_command_and_scene():
    page = (SITE / "guide" / "commands.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^## pgo (\w+)$", page, re.M)) == set(COMMANDS)
    for scene in cli_options.Scene:
        assert f"`{scene.value}`" in section_of("generate")


QUESTIONS = re.findall(
    r"^\| (.*\?) \| (.*) \| (.*) \|$",
    (SITE / "guide" / "how_do_i.md").read_text(encoding="utf-8"),
    re.M,
)
# Answers that are not run here: they need GTSAM, the network, a cluster, or a class of the reader.
NOT_RUN = (
    "solve edges of a table, as pandas writes a frame without its index?",
    "read a factor graph of GTSAM?",
    "certify GTSAM's answer?",
    "get a public benchmark graph?",
    "run robots on several machines?",
    "let robots on machines of their own find one map?",
    "write my own splitting method?",
)


def answers(cell: str) -> list[str]:
    """The commands or lines of Python of an answer."""
    return re.findall(r"`([^`]+)`", cell)


def test_every_command_that_answers_a_question_has_the_options_it_is_given():
    for question, answer, _ in QUESTIONS:
        for line in answers(answer):
            if not line.startswith("pgo "):
                continue
            _, command, *words = shlex.split(line)
            known = {name for option in COMMANDS[command].params for name in option.opts}
            given = {word for word in words if word.startswith("-")}
            assert given <= known, question


@pytest.mark.slow
def test_the_answers_do_what_the_questions_ask(pgo_command, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PGO_DATA", raising=False)
    text = (SITE / "guide" / "how_do_i.md").read_text(encoding="utf-8")
    (_, command), (_, imports) = BLOCK.findall(text)
    assert pgo_command(*shlex.split(command.splitlines()[0])[2:])[0] == 0
    names: dict[str, object] = {}
    exec(imports.replace(">>> ", ""), names)
    for question, answer, _ in QUESTIONS:
        if question in NOT_RUN:
            continue
        for line in answers(answer):
            if line.startswith("pgo "):
                code, _, err = pgo_command(*shlex.split(line)[1:])
                assert code in (0, 3), f"{line}\n{err}"
            else:
                exec(line, names)


GALLERY = runpy.run_path(str(SITE / "gallery.py"))  # the script is not run


@pytest.mark.slow
def test_the_blocks_of_the_gallery_make_figures(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    blocks = GALLERY["blocks_with_pictures"](GALLERY["PAGE"].read_text(encoding="utf-8"))
    for picture, figure in GALLERY["drawn"](blocks):
        is_figure = hasattr(figure, "savefig") or hasattr(figure, "write_html")
        assert is_figure or figure.suffix == ".html", picture
