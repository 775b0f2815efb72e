"""Assemble pages, notebooks and reference, and build them as HTML that opens offline.

    python notebooks/site/build.py            # writes notebooks/site/_build/html/index.html
    python notebooks/site/build.py --links    # also checks that every external address answers

The command needs the extra `docs`, and treats a warning as an error. The pages are the .md files
beside this file. The notebooks are those of the folder above, with their committed outputs.
Benchmarks and changelog are the files of the repository, and the reference is made from the
docstrings.
"""

import argparse
import ast
import json
import os
import re
import shutil
import sys
import tomllib
from html import unescape
from pathlib import Path
from typing import Any
from urllib.parse import quote

SITE = Path(__file__).parent
ROOT = SITE.parent.parent
sys.path.insert(0, str(ROOT))

import pgo_models  # noqa: E402 - on the path that is set above
import solvers  # noqa: E402
from pgo_models.errors import MissingExtraError, extra_module  # noqa: E402
from pgo_models.plots.pages import FILM, figure_html  # noqa: E402

PACKAGES = {"pgo_models": pgo_models, "solvers": solvers}
# Pages of the repository, and their names on the site; links between them are adapted.
PAGES = {
    "tests/benchmarks/README.md": "benchmarks.md",
    "CHANGELOG.md": "changelog.md",
    "data/README.md": "data.md",
}
PLOTLY_SCRIPT = "../_static/plotly.min.js"  # of `conf.py`, seen from the pages of the notebooks
FRONT_FILM = (
    ROOT / "notebooks" / "14_is_it_really_the_best.ipynb"
)  # whose first film opens the site
# Files of the repository that are no page of the site, and the page that a link to them opens.
INSTEAD = {"README.md": "index.md"}


def relinked(text: str, page: str) -> str:
    """Return the text of a page of the repository with its links adapted to the site.

    A link to another page leads to its name on the site. A link to another file becomes its label,
    followed by the path as code.
    """

    def link(match: re.Match[str]) -> str:
        label, target = match.groups()
        if target.startswith(("http", "#")):
            return match[0]
        path = os.path.normpath(Path(page).parent / target).replace(os.sep, "/")
        if path in PAGES or path in INSTEAD:
            return f"[{label}]({PAGES.get(path) or INSTEAD[path]})"
        if path.startswith("notebooks/"):
            return f"[{label}]({path.removeprefix('notebooks/site/')})"
        return f"{label} (`{path}`)"

    return re.sub(r"\[([^\]]+)\]\(([^)]+)\)", link, text)


def first_sentence(text: str) -> str:
    """Return the first sentence of a docstring, on one line and without its period."""
    line = " ".join(text.strip().split("\n\n")[0].split())
    return re.split(r"(?<=[^.])\.(?:\s|$)", line)[0]


def rooms(package: str) -> list[Path]:
    """Return the folders of a package that hold modules, `distributed/robots` after its parent."""
    packages = sorted((ROOT / package).glob("*/**/__init__.py"))
    return [path.parent for path in packages if path.parent.name != "command"]


def docstring_of(path: Path) -> str:
    """Return the docstring of a file, without importing the file."""
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""


def reference_of_modules(paths: list[Path]) -> list[str]:
    """Return the lines of a reference page: one section per module."""
    lines = []
    for path in paths:
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        lines += [
            path.stem,
            "-" * len(path.stem),
            "",
            f".. automodule:: {module}",
            "   :members:",
            "",
        ]
    return lines


def modules_of(folder: Path) -> list[Path]:
    """Return the modules of a folder, without its `__init__.py`."""
    return [path for path in sorted(folder.glob("*.py")) if path.stem != "__init__"]


def underlined(title: str) -> list[str]:
    """Return a title in reStructuredText, and an empty line."""
    return [title, "=" * len(title), ""]


def table_of_names(package: str) -> list[str]:
    """Return a Markdown table of the public names of a package, with the first sentence of each."""
    import docstrings  # beside this file; needs the packages

    module = PACKAGES[package]
    lines = ["| name | what it is |", "|---|---|"]
    for name in module.__all__:
        target = docstrings.NAMES[f"{package}.{name}"]
        sentence = table_text(first_sentence(getattr(module, name).__doc__))
        lines.append(f"| {{py:obj}}`{name} <{target}>` | {sentence} |")
    return lines


def write_room(folder: Path, room: Path) -> str:
    """Write the page of one room, and return the name of the room."""
    import docstrings

    name = ".".join(room.relative_to(ROOT).parts)
    summary = docstrings.escaped(docstring_of(room / "__init__.py"))
    lines = [*underlined(name), summary, "", *reference_of_modules(modules_of(room))]
    (folder / f"{name}.rst").write_text("\n".join(lines), encoding="utf-8")
    return name


def write_reference(folder: Path) -> None:
    """Write a page for every room, one for the modules of each package, and their index."""
    folder.mkdir()
    index = [
        "# Reference",
        "",
        "The reference is ordered by rooms. A file imports only from its own room and from earlier",
        "rooms.",
        "",
    ]
    for package, module in PACKAGES.items():
        index += [f"## {package}", "", first_sentence(module.__doc__) + ".", ""]
        index += table_of_names(package)
        names = [write_room(folder, room) for room in rooms(package)]
        lines = [*underlined(package), "Modules of the package that are in no room.", ""]
        lines += reference_of_modules(modules_of(ROOT / package))
        (folder / f"{package}.rst").write_text("\n".join(lines), encoding="utf-8")
        index += ["", "```{toctree}", ":maxdepth: 1", "", package, *names, "```", ""]
    (folder / "index.md").write_text("\n".join(index), encoding="utf-8")


def table_text(text: str) -> str:
    """Return text for a cell of a Markdown table, in which only code and formulas are markup."""
    import formulas  # beside this file

    cell = ""
    for k, piece in enumerate(re.split(r"(`[^`]+`)", text)):
        if k % 2:
            cell += piece
            continue
        for part, is_formula in formulas.inline(piece):
            cell += f"${part}$" if is_formula else re.sub(r"([|*_$])", r"\\\1", part)
    return cell


def repository_address(pyproject: str) -> str | None:
    """Return the address under `Repository` in the table `[project.urls]`, or None."""
    return tomllib.loads(pyproject)["project"].get("urls", {}).get("Repository")


def binder_link(address: str, notebook: str) -> str:
    """Return the address at which Binder opens a notebook of a public git repository."""
    path = quote(f"notebooks/{notebook}", safe="")
    return f"https://mybinder.org/v2/git/{quote(address, safe='')}/HEAD?labpath={path}"


def with_link_to_run(content: dict[str, Any], address: str, notebook: str) -> None:
    """Add a link to Binder to the first cell of a notebook, below the line that installs it."""
    link = f"[Or run it without installing]({binder_link(address, notebook)})"
    how = "[as described here](../notebooks.md#without-installing)"
    source = "".join(content["cells"][0]["source"])
    title, installing, rest = source.split("\n\n", 2)
    content["cells"][0]["source"] = "\n\n".join([title, installing, f"{link}, {how}.", rest])


def with_films(notebook: str) -> dict[str, Any]:
    """Return a notebook whose plotly figures are HTML that needs no Python.

    Links to pages of the site lead to them from where notebooks are on the site.
    """
    content = json.loads(notebook.replace("](site/", "](../"))
    script: str | bool = PLOTLY_SCRIPT  # which a page loads with its first film
    for cell in content["cells"]:
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if FILM in data:
                figure = extra_module("plotly.io", "docs").from_json(json.dumps(data[FILM]))
                height = f"{figure.layout.height or 480}px"
                output["data"] = {"text/html": figure_html(figure, script, height)}
                script = False
    return content


def fill_front_pages(source: Path, address: str | None) -> None:
    """Put films, thumbnails and links where comments of front page and indices ask for them.

    What stands between two comments `binder` is left out if the repository has no address.
    """
    import pictures  # beside this file; needs plotly

    film = json.dumps(pictures.outputs(FRONT_FILM, FILM)[0])
    figure = extra_module("plotly.io", "docs").from_json(film)
    html = figure_html(figure, PLOTLY_SCRIPT.removeprefix("../"), f"{figure.layout.height}px")
    table = pictures.table_of_notebooks(source)
    for page, mark, text in (
        ("index.md", "<!-- film -->", pictures.raw_html(html)),
        ("notebooks.md", "<!-- notebooks -->", table),
    ):
        path = source / page
        content = path.read_text(encoding="utf-8").replace(mark, text)
        if address is None:
            content = re.sub(r"<!-- binder -->.*?<!-- /binder -->", "", content, flags=re.S)
        path.write_text(content, encoding="utf-8")
    gallery = source / "guide" / "gallery.md"
    text = pictures.with_thumbnails(gallery.read_text(encoding="utf-8"))
    gallery.write_text(text, encoding="utf-8")


def assemble(source: Path, address: str | None) -> None:
    """Write all pages, notebooks and pictures to a folder.

    Notebooks get links that run them if the repository has an address.
    """
    shutil.copytree(
        SITE, source, ignore=shutil.ignore_patterns("_build", "*.py", "static", "__pycache__")
    )
    fill_front_pages(source, address)
    (source / "notebooks").mkdir()
    notebooks = sorted((ROOT / "notebooks").glob("[0-9][0-9]_*.ipynb"))
    for notebook in notebooks:
        content = with_films(notebook.read_text(encoding="utf-8"))
        if address is not None:
            with_link_to_run(content, address, notebook.name)
        (source / "notebooks" / notebook.name).write_text(json.dumps(content), encoding="utf-8")
    shutil.copytree(
        ROOT / "notebooks" / "drawings",
        source / "notebooks" / "drawings",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    shutil.copytree(ROOT / "notebooks" / "pictures", source / "notebooks" / "pictures")
    shutil.copy(ROOT / "notebooks" / "tables.json", source / "notebooks")
    for page, name in PAGES.items():
        text = (ROOT / page).read_text(encoding="utf-8")
        (source / name).write_text(relinked(text, page), encoding="utf-8")
    write_reference(source / "reference")
    import one_page  # beside this file; needs matplotlib

    one_page.write_page(source / "method.pdf")


def write_texts(html: Path) -> None:
    """Write what the pages say, of which `excerpts.js` shows pieces under the results of a search.

    A page that is opened from the disk may not read other pages, but it may load a script.
    """
    texts = {}
    for page in sorted(
        [*html.glob("*.html"), *html.glob("guide/*.html"), *html.glob("notebooks/*.html")]
    ):
        article = re.search(r"<article.*?</article>", page.read_text(encoding="utf-8"), re.S)
        if article is not None:
            shown = re.sub(r"<(script|style|svg|h1)\b.*?</\1>|<[^>]+>", " ", article[0], flags=re.S)
            name = page.relative_to(html).as_posix()
            texts[name] = " ".join(unescape(shown).replace("#", " ").split())
    script = f"const TEXTS = {json.dumps(texts)};\n"
    (html / "_static" / "texts.js").write_text(script, encoding="utf-8")


def main() -> int:
    """Assemble and build the site, and return the exit code of Sphinx."""
    parser = argparse.ArgumentParser(description="Build the documentation.")
    parser.add_argument(
        "--links", action="store_true", help="also check that external addresses answer"
    )
    parser.add_argument(
        "--out", type=Path, default=SITE / "_build", help="folder to build in; it is emptied first"
    )
    arguments = parser.parse_args()
    sys.path.insert(0, str(SITE))
    try:
        build_main = extra_module("sphinx.cmd.build", "docs").build_main
    except MissingExtraError as error:
        parser.error(str(error))
    out = arguments.out.resolve()
    for part in ("source", "html", "doctrees"):
        shutil.rmtree(out / part, ignore_errors=True)
    pyproject = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assemble(out / "source", repository_address(pyproject))
    options = [
        "-c",
        str(SITE),
        "-d",
        str(out / "doctrees"),
        "-W",
        "--keep-going",
        "-q",
        "-j",
        "auto",
    ]
    options.append(str(out / "source"))
    code = build_main(["-b", "html", *options, str(out / "html")])
    write_texts(out / "html")
    if code == 0 and arguments.links:
        code = build_main(["-b", "linkcheck", *options, str(out / "links")])
    if code == 0:
        print(f"built: {out / 'html' / 'index.html'}")
    return code


if __name__ == "__main__":
    sys.exit(main())
