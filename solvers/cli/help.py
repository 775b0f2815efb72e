"""Help of commands, and what is said of words that are none: groups, examples, suggestions."""

import difflib
import re
from collections.abc import Mapping, Sequence
from typing import Any

import typer
from typer.core import TyperCommand

# Words of click for what an option takes, and plain ones.
_METAVARS = {
    "<str>": "TEXT",
    "<path>": "FILE",
    "<list[Path]>": "FILE",
    "<float>": "NUMBER",
    "<float range>": "NUMBER",
    "<int>": "NUMBER",
    "<int range>": "NUMBER",
}
_ALIKE = 0.6  # how alike two words are, by difflib, of which one is suggested for the other


class Helpful(TyperCommand):
    """A command whose help has its options in groups, and examples at the end."""

    groups: Mapping[str, Sequence[str]] = {}
    examples: Sequence[str] = ()

    def collect_usage_pieces(self, ctx: Any) -> list[str]:  # noqa: ANN401 - of click, which typer carries or imports
        """Names of options and arguments for the first line."""
        return [piece.strip("{}") for piece in super().collect_usage_pieces(ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - of click, which typer carries or imports
        """Write arguments and options, those without a group last."""
        records: dict[str, list[tuple[str, str]]] = {
            "Arguments": [],
            **{g: [] for g in self.groups},
        }
        group_of = {name: group for group, names in self.groups.items() for name in names}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is None:
                continue
            is_argument = parameter.param_type_name == "argument"
            others = "Other options" if self.groups else "Options"
            group = "Arguments" if is_argument else group_of.get(parameter.name or "", others)
            names, text = record
            names = names.split()[0] if is_argument else names
            records.setdefault(group, []).append((_plain(names), text))
        for group, rows in records.items():
            if rows:
                with formatter.section(group):
                    formatter.write_dl(rows)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - as above
        """Write the examples."""
        if self.examples:
            with formatter.section("Examples"):
                formatter.write("".join(f"  {example}\n" for example in self.examples))


def _plain(names: str) -> str:
    """Names of an option with a plain word for what it takes."""
    for word, plain in _METAVARS.items():
        names = names.replace(word, plain)
    return re.sub(r"<([^<>]*\|[^<>]*)>", r"\1", names)


def text_of_usage_error(error: Exception) -> str:
    """One line on wrong arguments: what is wrong, what may be meant, and whose help says more."""
    is_bad_value = isinstance(error, typer.BadParameter)
    text = error.format_message() if is_bad_value else str(error)  # type: ignore[attr-defined]
    text = text.replace("Value error, ", "").rstrip(".")
    context: Any = getattr(error, "ctx", None)
    suggestion = "" if "Did you mean" in text else _suggestion(text, context)
    has_command = context is not None and context.parent is not None
    command = f"pgo {context.info_name}" if has_command else "pgo"
    return f"{text}{suggestion}; see {command} --help"


def _suggestion(text: str, context: Any) -> str:  # noqa: ANN401 - of click's Context
    option = re.search(r"No such option: (\S+)", text)
    if option is not None and context is not None:
        parameters = context.command.get_params(context)
        known = [name for parameter in parameters for name in parameter.opts if name[:1] == "-"]
        return _meant(option[1], known)
    choice = re.search(r"'([^']*)' is not one of (.*)", text)
    if choice is not None:
        return _meant(choice[1], re.findall(r"'([^']*)'", choice[2]))
    return ""


def _meant(word: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1, cutoff=_ALIKE)
    return f"; did you mean {close[0]}?" if close else ""
