"""Docstrings as reStructuredText: prose is literal but for `code` and **bold**, indented lines are formulas.

The docstrings are written to be read as they stand. What reStructuredText would take for markup (|x|, R_i, a * b) is
escaped; a block that is indented against the prose around it becomes a literal block; examples stay examples. Names in
backticks that are public become links. The words beside the fields of a dataclass become its attributes.
"""

import dataclasses
import enum
import inspect
import re
from collections.abc import Iterator

from docutils import nodes
from sphinx.addnodes import desc_annotation, pending_xref

import pgo_models
import solvers

SECTIONS = ("Parameters", "Returns", "Yields", "Raises", "Examples", "Attributes", "Notes", "References", "See Also")
LIST_ITEM = re.compile(r"(?:[-*+]|\d+\.|\([a-z]\)) ")
ARRAY = re.compile(
    r"~?(?:numpy\.)?ndarray\[~?tuple\[~?(?:typing\.)?Any, \.\.\.\], "
    r"~?(?:numpy\.)?dtype\[~?(?:numpy\.|typing\.)?(\w+)\]\]"
)
ARRAYS = {"float64": "Array", "int64": "IntArray", "bool": "BoolArray", "bool_": "BoolArray", "Any": "ndarray"}
FIELD = re.compile(r"^    (\w+): ([^=#]+?)(?: = .*?)?  # (.+)$")


def public_names() -> dict[str, str]:
    """Where each public name is defined, by the ways of writing it."""
    found = {}
    for package, short in ((pgo_models, "pgo"), (solvers, "solvers")):
        for name in package.__all__:
            thing = getattr(package, name)
            where = f"{thing.__module__}.{thing.__qualname__}"
            found |= {name: where, f"{short}.{name}": where, f"{package.__name__}.{name}": where}
    return found


NAMES = public_names()


def as_code(text: str) -> str:
    """A link to a public name, else a literal."""
    name = text.removesuffix("()").removesuffix("(..)")
    if name in NAMES:
        return f":py:obj:`{text} <{NAMES[name]}>`"
    return f"``{text}``"


def escaped(line: str) -> str:
    """One line of prose."""
    pieces = re.split(r"(``[^`]+``|`[^`]+`|\*\*[^*\s](?:[^*]*[^*\s])?\*\*)", line)
    for k, piece in enumerate(pieces):
        if k % 2 == 0:
            pieces[k] = re.sub(r"([*|_\\`]|(?<=\bfile):)", r"\\\1", piece)  # file:line is no address
        elif piece.startswith("`") and not piece.startswith("``"):
            pieces[k] = as_code(piece.strip("`"))
            before, after = pieces[k - 1], re.sub(r"^\\?", "", pieces[k + 1])
            pieces[k] = ("" if re.search(r"(^|[\s('\"\[{</:-])$", before) else "\\ ") + pieces[k]
            pieces[k] += "" if re.match(r"[\s'\")\]}>/:.,;!?-]|$", after) else "\\ "
    return "".join(pieces)


def parameter(line: str) -> str:
    """A line of a section: "name : type" with a literal type, or prose."""
    if match := re.match(r"(\w+(?:, \w+)*) : (.+)$", line):
        return f"{match[1]} : ``{match[2].replace('`', '')}``"
    return escaped(line)


def attributes(block: list[str]) -> list[str]:
    """Lines of the section Attributes, as a list: names and type, and what they are."""
    out = []
    for line in block:
        if line.startswith(" "):
            out.append("  " + escaped(line.strip()))
        else:
            names, _, kind = line.partition(" : ")
            out += ["", f"* **{names.strip().rstrip(',')}**" + (f" (``{kind.replace('`', '')}``)" if kind else "")]
    return out


def indentation(line: str) -> int:
    """Blanks at its beginning."""
    return len(line) - len(line.lstrip())


def blocks(lines: list[str]) -> Iterator[list[str]]:
    """Lines between empty ones."""
    block: list[str] = []
    for line in [*lines, ""]:
        if line.strip():
            block.append(line)
        elif block:
            yield block
            block = []


def split_formulas(block: list[str], base: int) -> Iterator[list[str]]:
    """A block of prose with indented lines in it, taken apart; what belongs to a list item stays with it."""
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
    """A numpydoc docstring, ready for napoleon."""
    out: list[str] = []
    in_section = is_attributes = False
    for block in blocks(lines):
        head = block[0].strip()
        if head in SECTIONS and len(block) > 1 and set(block[1].strip()) == {"-"}:
            in_section = head not in ("Examples", "Notes", "References")
            is_attributes = head == "Attributes"
            out += [".. rubric:: Attributes", ""] if is_attributes else block[:2]
            block = block[2:]
            if not block:
                continue
            head = block[0].strip()
        if head.startswith(">>>"):
            out += [*block, ""]
        elif in_section:
            out += [*(attributes(block) if is_attributes else map(parameter, block)), ""]
        else:
            for part in split_formulas(block, 0):
                if indentation(part[0]) > 0 and not LIST_ITEM.match(part[0].strip()):
                    out += ["::", "", *part, ""]
                else:
                    out += [*items_apart(part), ""]
    return out


def items_apart(block: list[str]) -> list[str]:
    """Prose; where it is a list, with its items apart and what follows them indented as the first line."""
    if not LIST_ITEM.match(block[0].strip()):
        return [escaped(line) for line in block]
    out: list[str] = []
    for line in block:
        text = line.strip()
        if mark := LIST_ITEM.match(text):
            out += ["", mark[0] + escaped(text[mark.end() :])]
            width = mark.end()
        else:
            out.append(" " * width + escaped(text))
    return out[1:]


def described_fields(thing: type) -> list[str]:
    """The words beside the fields of a dataclass, as a section of its docstring."""
    try:
        source = inspect.getsource(thing).splitlines()
    except OSError:
        return []
    found = [match.groups() for line in source if (match := FIELD.match(line))]
    names = {field.name for field in dataclasses.fields(thing)}
    lines = []
    for name, kind, words in found:
        if name in names:
            lines += [f"{name} : {kind.strip()}", f"    {words}"]
    return ["Attributes", "----------", *lines, ""] if lines else []


def process(app: object, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Hook of autodoc, before napoleon's."""
    if what in ("attribute", "data") and not inspect.getdoc(thing):
        return
    found = as_rest(lines)
    is_described = any(line.strip() in ("Parameters", "Attributes") for line in lines)
    if what == "class" and dataclasses.is_dataclass(thing) and not is_described:
        fields = as_rest(described_fields(thing))
        where = next((k for k, line in enumerate(found) if line.strip() in SECTIONS), len(found))
        found = [*found[:where], "", *fields, *found[where:]]
    if what == "class" and issubclass(thing, enum.Enum):
        found += ["", *(f"* **{member.name}**: {escaped(str(member.value))}" for member in thing), ""]
    lines[:] = found


def link_types(app: object, tree: nodes.document) -> None:
    """Types in signatures: public names become links, all others words, for which Sphinx would search all classes."""
    for found in list(tree.findall(pending_xref)):
        if found.get("refdomain") == "py" and found.get("refspecific"):
            target = NAMES.get(found["reftarget"].removeprefix("~").rpartition(".")[2])
            if target is None:
                found.replace_self(found.children)
            else:
                found["reftarget"], found["refspecific"] = target, False


def short_types(app: object, tree: nodes.document) -> None:
    """Types of properties, which no hook on signatures sees, with the project's names for arrays."""
    for found in tree.findall(desc_annotation):
        text = found.astext()
        if (short := with_names(text)) != text:
            found.children = []
            found += nodes.Text(short)


def with_names(text: str) -> str:
    """A type with the project's names for arrays in place of what they stand for."""
    return ARRAY.sub(lambda match: ARRAYS.get(match[1], match[0]), text)


def with_array_names(app: object, what: str, name: str, thing: object, options: object, *texts: str | None) -> tuple:
    """Signature and what is returned, with the project's names for arrays in place of what they stand for."""
    return tuple(text and with_names(text) for text in texts)


def connect(app: object) -> None:
    """Ask Sphinx to call these on every docstring, before napoleon reads it, on every signature and on every page."""
    app.connect("autodoc-process-docstring", process, priority=400)
    app.connect("autodoc-process-signature", with_array_names)
    app.connect("doctree-read", link_types)
    app.connect("doctree-read", short_types)
