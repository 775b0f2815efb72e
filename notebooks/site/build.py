"""Assemble the documentation's pages, notebooks and reference, and build them as HTML that opens offline.

    python notebooks/site/build.py            # notebooks/site/_build/html/index.html; a warning is an error
    python notebooks/site/build.py --links    # also asks every address outside whether it answers

Needs the extra `docs`. Pages are the .md files beside this; the notebooks are those of the folder above, with the
outputs they were committed with; benchmarks and changelog are those of the repository; the reference is made from the
docstrings.
"""

import argparse
import ast
import os
import re
import shutil
import sys
from pathlib import Path

SITE = Path(__file__).parent
ROOT = SITE.parent.parent
sys.path.insert(0, str(ROOT))

import pgo_models  # noqa: E402 - found above
import solvers  # noqa: E402
from pgo_models.errors import MissingExtraError, extra_module  # noqa: E402

PACKAGES = {"pgo_models": pgo_models, "solvers": solvers}
# What a page of the repository becomes here; links between them follow.
PAGES = {
    "tests/benchmarks/README.md": "benchmarks.md",
    "CHANGELOG.md": "changelog.md",
    "data/README.md": "data.md",
}
# Where links of those pages go that mean a file of the repository that is no page here.
INSTEAD = {"README.md": "index.md"}


def relinked(text: str, page: str) -> str:
    """A page of the repository with its links to other pages as they are here, those to other files as plain words."""

    def link(match: re.Match[str]) -> str:
        label, target = match.groups()
        if target.startswith(("http", "#")):
            return match[0]
        path = os.path.normpath(Path(page).parent / target).replace(os.sep, "/")
        if path in PAGES or path in INSTEAD:
            return f"[{label}]({PAGES.get(path) or INSTEAD[path]})"
        if path.startswith("notebooks/"):
            return f"[{label}]({path})"
        return f"{label} (`{path}`)"

    return re.sub(r"\[([^\]]+)\]\(([^)]+)\)", link, text)


def first_sentence(text: str) -> str:
    """Of a docstring, on one line."""
    line = " ".join(text.strip().split("\n\n")[0].split())
    return re.split(r"(?<=[^.])\.(?:\s|$)", line)[0]


def rooms(package: str) -> list[Path]:
    """Folders of a package that hold modules, `distributed/robots` after `distributed`."""
    doors = sorted((ROOT / package).glob("*/**/__init__.py"))
    return [door.parent for door in doors if door.parent.name != "command"]


def docstring_of(path: Path) -> str:
    """Of a file, without importing it."""
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""


def reference_of_modules(paths: list[Path]) -> list[str]:
    """Sections of a page, one for every module."""
    lines = []
    for path in paths:
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        lines += [path.stem, "-" * len(path.stem), "", f".. automodule:: {module}", "   :members:", ""]
    return lines


def write_reference(folder: Path) -> None:
    """A page for every room, and one for each package with its public names."""
    import docstrings  # beside this file; needs the packages

    folder.mkdir()
    index = ["# Reference", "", "Room by room: a file imports only from its own room and from earlier ones.", ""]
    for package, module in PACKAGES.items():
        index += [f"## {package}", "", first_sentence(module.__doc__) + ".", "", "| name | what it is |", "|---|---|"]
        for name in module.__all__:
            target = docstrings.NAMES[f"{package}.{name}"]
            sentence = table_text(first_sentence(getattr(module, name).__doc__))
            index.append(f"| {{py:obj}}`{name} <{target}>` | {sentence} |")
        names = []
        for room in rooms(package):
            name = ".".join(room.relative_to(ROOT).parts)
            sentence = docstring_of(room / "__init__.py")
            paths = [path for path in sorted(room.glob("*.py")) if path.stem != "__init__"]
            lines = [name, "=" * len(name), "", docstrings.escaped(sentence), "", *reference_of_modules(paths)]
            (folder / f"{name}.rst").write_text("\n".join(lines), encoding="utf-8")
            names.append(name)
        door = [path for path in sorted((ROOT / package).glob("*.py")) if path.stem != "__init__"]
        lines = [package, "=" * len(package), "", "What lies at the door of the package.", ""]
        lines += reference_of_modules(door)
        (folder / f"{package}.rst").write_text("\n".join(lines), encoding="utf-8")
        index += ["", "```{toctree}", ":maxdepth: 1", "", package, *names, "```", ""]
    (folder / "index.md").write_text("\n".join(index), encoding="utf-8")


def table_text(text: str) -> str:
    """Plain words in a cell of a Markdown table."""
    pieces = re.split(r"(`[^`]+`)", text)
    return "".join(piece if k % 2 else re.sub(r"([|*_])", r"\\\1", piece) for k, piece in enumerate(pieces))


def assemble(source: Path) -> None:
    """Write all pages to a folder."""
    shutil.copytree(SITE, source, ignore=shutil.ignore_patterns("_build", "*.py", "static", "__pycache__"))
    (source / "notebooks").mkdir()
    notebooks = sorted((ROOT / "notebooks").glob("[0-9][0-9]_*.ipynb"))
    for notebook in notebooks:
        shutil.copy(notebook, source / "notebooks")
    for extra in ("pictures", "tables.json"):
        found = ROOT / "notebooks" / extra
        (shutil.copytree if found.is_dir() else shutil.copy)(found, source / "notebooks" / extra)
    for page, name in PAGES.items():
        text = (ROOT / page).read_text(encoding="utf-8")
        (source / name).write_text(relinked(text, page), encoding="utf-8")
    write_reference(source / "reference")


def main() -> int:
    """Assemble and build; the exit code of Sphinx."""
    parser = argparse.ArgumentParser(description="Build the documentation.")
    parser.add_argument("--links", action="store_true", help="also ask addresses outside whether they answer")
    parser.add_argument("--out", type=Path, default=SITE / "_build", help="folder to build in; it is emptied first")
    arguments = parser.parse_args()
    sys.path.insert(0, str(SITE))
    try:
        build_main = extra_module("sphinx.cmd.build", "docs").build_main
    except MissingExtraError as error:
        parser.error(str(error))
    out = arguments.out.resolve()
    for part in ("source", "html", "doctrees"):
        shutil.rmtree(out / part, ignore_errors=True)
    assemble(out / "source")
    options = ["-c", str(SITE), "-d", str(out / "doctrees"), "-W", "--keep-going", "-q", "-j", "auto"]
    options.append(str(out / "source"))
    code = build_main(["-b", "html", *options, str(out / "html")])
    if code == 0 and arguments.links:
        code = build_main(["-b", "linkcheck", *options, str(out / "links")])
    if code == 0:
        print(f"built: {out / 'html' / 'index.html'}")
    return code


if __name__ == "__main__":
    sys.exit(main())
