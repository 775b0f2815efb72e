"""Docstrings as reStructuredText, for the reference of the site.

The docstrings are written as plain text, with `code` and **bold** as the only markup. Everything
else that reStructuredText would take for markup (|x|, R_i, a * b) is escaped. A block that is
indented relative to the prose around it is displayed: typeset if it is a formula that `formulas.py`
can read, else as it is written. Formulas in the prose are typeset, too. Examples stay examples. A
public name in backticks becomes a link. The comments beside the fields of a dataclass become its
attributes.
"""

import dataclasses
import enum
import inspect
import re
from collections.abc import Iterator

import formulas  # beside this file
from docutils import nodes
from sphinx.addnodes import desc_annotation, pending_xref

import pgo_models
import solvers

SECTIONS = (
    "Parameters",
    "Returns",
    "Yields",
    "Raises",
    "Examples",
    "Attributes",
    "Notes",
    "References",
    "See Also",
)
LIST_ITEM = re.compile(r"(?:[-*+]|\d+\.|\([a-z]\)) ")
ARRAY = re.compile(
    r"~?(?:numpy\.)?ndarray\[~?tuple\[~?(?:typing\.)?Any, \.\.\.\], "
    r"~?(?:numpy\.)?dtype\[~?(?:numpy\.|typing\.)?(\w+)(?:\[~?(?:typing\.)?Any\])?\]\]"
)
ARRAYS = {
    "float64": "Array",
    "integer": "IntArray",
    "int64": "IntArray",
    "bool": "BoolArray",
    "bool_": "BoolArray",
    "Any": "ndarray",
}
FIELD = re.compile(r"^    (\w+): ([^=#]+?)(?: = .*?)?  # (.+)$")


def public_names() -> dict[str, str]:
    """Return the full name of each public name, by the ways in which docstrings write it."""
    full_names = {}
    for package, short in ((pgo_models, "pgo"), (solvers, "solvers")):
        for name in package.__all__:
            thing = getattr(package, name)
            inside = inspect.unwrap(thing)
            full = f"{inside.__module__}.{inside.__qualname__}"
            spellings = (name, f"{short}.{name}", f"{package.__name__}.{name}")
            full_names |= dict.fromkeys(spellings, full)
    return full_names


NAMES = public_names()


def as_code(text: str) -> str:
    """Return a link to a public name, or else a literal."""
    name = text.removesuffix("()").removesuffix("(..)")
    if name in NAMES:
        return f":py:obj:`{text} <{NAMES[name]}>`"
    return f"``{text}``"


def escaped(text: str, has_formulas: bool = True) -> str:
    """Return prose in which only code, bold, links and formulas are markup."""
    pieces = re.split(r"(``[^`]+``|`[^`]+`|\*\*[^*\s](?:[^*]*[^*\s])?\*\*)", text)
    for k, piece in enumerate(pieces):
        if k % 2 == 0:
            parts = formulas.inline(piece) if has_formulas else [(piece, False)]
            pieces[k] = "".join(
                f":math:`{part}`" if is_formula else without_markup(part)
                for part, is_formula in parts
            )
        elif piece.startswith("`") and not piece.startswith("``"):
            pieces[k] = as_code(piece.strip("`"))
            before = pieces[k - 1]
            after = re.sub(r"^\\?", "", pieces[k + 1])
            pieces[k] = ("" if re.search(r"(^|[\s('\"\[{</:-])$", before) else "\\ ") + pieces[k]
            pieces[k] += "" if re.match(r"[\s'\")\]}>/:.,;!?-]|$", after) else "\\ "
    return "".join(pieces)


def without_markup(text: str) -> str:
    """Return prose in which nothing is markup; "file:" would begin an address."""
    return re.sub(r"([*|_\\`]|(?<=\bfile):)", r"\\\1", text, flags=re.I)


def joined(block: list[str]) -> list[str]:
    """Return lines of which those that are indented alike are one; a formula may go across them."""
    out: list[str] = []
    for line in block:
        if out and indentation(line) == indentation(out[-1]) > 0:
            out[-1] += " " + line.strip()
        else:
            out.append(line)
    return out


def parameter(line: str) -> str:
    """Return a line of a section: "name : type" with the type as a literal, a type, or prose."""
    if match := re.match(r"(\w+(?:, \w+)*) : (.+)$", line):
        return f"{match[1]} : ``{match[2].replace('`', '')}``"
    return escaped(line, has_formulas=line.startswith(" "))


def attributes(block: list[str]) -> list[str]:
    """Return the lines of the section Attributes as a list of names, types and meanings."""
    out = []
    for line in block:
        if line.startswith(" "):
            out.append("  " + escaped(line.strip()))
        else:
            names, _, kind = line.partition(" : ")
            out += [
                "",
                f"* **{names.strip().rstrip(',')}**"
                + (f" (``{kind.replace('`', '')}``)" if kind else ""),
            ]
    return out


def indentation(line: str) -> int:
    """Return the number of blanks at the beginning of a line."""
    return len(line) - len(line.lstrip())


def blocks(lines: list[str]) -> Iterator[list[str]]:
    """Yield the blocks of lines that empty lines separate."""
    block: list[str] = []
    for line in [*lines, ""]:
        if line.strip():
            block.append(line)
        elif block:
            yield block
            block = []


def split_formulas(block: list[str], base: int) -> Iterator[list[str]]:
    """Split a block of prose at its indented lines; the lines of a list item stay together."""
    if LIST_ITEM.match(block[0].strip()):
        yield block
        return
    part: list[str] = []
    for line in block:
        if part and (indentation(line) > base) != (indentation(part[-1]) > base):
            yield part
            part = []
        part.append(line)
    yield part


def as_rest(lines: list[str]) -> list[str]:
    """Return a numpydoc docstring in the form that napoleon reads."""
    out: list[str] = []
    in_section = is_attributes = in_references = False
    for block in blocks(lines):
        head = block[0].strip()
        if head in SECTIONS and len(block) > 1 and set(block[1].strip()) == {"-"}:
            in_section = head not in ("Examples", "Notes", "References")
            is_attributes = head == "Attributes"
            in_references = head == "References"
            out += [".. rubric:: Attributes", ""] if is_attributes else block[:2]
            block = block[2:]
            if not block:
                continue
            head = block[0].strip()
        if head.startswith(">>>"):
            out += [*block, ""]
        elif in_section:
            described = joined(block)
            out += [*(attributes(described) if is_attributes else map(parameter, described)), ""]
        elif in_references:
            out += [*(escaped(line, has_formulas=False) for line in block), ""]
        else:
            for part in split_formulas(block, 0):
                if indentation(part[0]) > 0 and not LIST_ITEM.match(part[0].strip()):
                    out += displayed(part)
                else:
                    out += [*items_apart(part), ""]
    return out


def displayed(block: list[str]) -> list[str]:
    """Return an indented block as a formula if it can be read as one, else as a literal block."""
    tex = formulas.display(block)
    if tex is None:
        return ["::", "", *block, ""]
    return [".. math::", "", f"    {tex}", ""]


def items_apart(block: list[str]) -> list[str]:
    """Return prose; in a list, separate the items and indent their continuation lines."""
    lines = [line.strip() for line in block]
    if not LIST_ITEM.match(lines[0]):
        return [escaped(" ".join(lines))]
    items: list[str] = []
    for line in lines:
        if LIST_ITEM.match(line):
            items.append(line)
        else:
            items[-1] += " " + line
    out: list[str] = []
    for item in items:
        mark = LIST_ITEM.match(item)[0]
        out += ["", mark + escaped(item.removeprefix(mark))]
    return out[1:]


def described_fields(thing: type) -> list[str]:
    """Return the comments beside the fields of a dataclass as a section of its docstring."""
    try:
        source = inspect.getsource(thing).splitlines()
    except OSError:
        return []
    names = {field.name for field in dataclasses.fields(thing)}
    lines = []
    for line in source:
        match = FIELD.match(line)
        if match and match[1] in names:
            name, kind, meaning = match.groups()
            lines += [f"{name} : {kind.strip()}", f"    {meaning}"]
    return ["Attributes", "----------", *lines, ""] if lines else []


def process(
    app: object, what: str, name: str, thing: object, options: object, lines: list[str]
) -> None:
    """Convert a docstring in place; autodoc calls this before napoleon."""
    if what in ("attribute", "data") and not inspect.getdoc(thing):
        return
    converted = as_rest(lines)
    is_described = any(line.strip() in ("Parameters", "Attributes") for line in lines)
    if what == "class" and dataclasses.is_dataclass(thing) and not is_described:
        converted = with_fields(converted, thing)
    if what == "class" and issubclass(thing, enum.Enum):
        members = [f"* **{member.name}**: {escaped(str(member.value))}" for member in thing]
        converted += ["", *members, ""]
    if what in ("attribute", "data", "property") and converted:
        # Napoleon would take what stands before a colon of the first line for a type.
        converted[:1] = re.split(r"(?<=:) ", converted[0], maxsplit=1)
    lines[:] = converted


def with_fields(lines: list[str], thing: type) -> list[str]:
    """Insert the fields of a dataclass before the first section of its docstring."""
    sections = [k for k, line in enumerate(lines) if line.strip() in SECTIONS]
    first = sections[0] if sections else len(lines)
    return [*lines[:first], "", *as_rest(described_fields(thing)), *lines[first:]]


def link_types(app: object, tree: nodes.document) -> None:
    """Make public names in signatures links, and all other types plain words.

    Sphinx would search all classes for the other types.
    """
    for reference in list(tree.findall(pending_xref)):
        if reference.get("refdomain") != "py":
            continue
        if not reference.get("refspecific") and reference["reftarget"] not in NAMES:
            continue
        target = NAMES.get(reference["reftarget"].removeprefix("~").rpartition(".")[2])
        if target is None:
            reference.replace_self(reference.children)
        else:
            reference["reftarget"] = target
            reference["refspecific"] = False


def short_types(app: object, tree: nodes.document) -> None:
    """Use the project's names for arrays in the types of properties, which have no signature."""
    for annotation in tree.findall(desc_annotation):
        text = annotation.astext()
        short = with_names(text)
        if short != text:
            annotation.children = []
            annotation += nodes.Text(short)


def with_names(text: str) -> str:
    """Return a type with the project's names for arrays instead of their definitions."""
    return ARRAY.sub(lambda match: ARRAYS.get(match[1], match[0]), text)


def with_array_names(
    app: object, what: str, name: str, thing: object, options: object, *texts: str | None
) -> tuple:
    """Return a signature and its return type with the project's names for arrays."""
    return tuple(text and with_names(text) for text in texts)


def connect(app: object) -> None:
    """Register the hooks for docstrings, before napoleon reads them, signatures and pages."""
    app.connect("autodoc-process-docstring", process, priority=400)
    app.connect("autodoc-process-signature", with_array_names)
    app.connect("doctree-read", link_types)
    app.connect("doctree-read", short_types)
