"""The checks at the end of a notebook: one that fails says which number moved."""

import ast
import linecache
from collections.abc import Iterator
from types import TracebackType

import numpy as np

MOST_CHARACTERS = 200  # of a value that is shown
# What a statement raises that is false, or whose numbers are not there after a change.
FAILURES = (AssertionError, AttributeError, LookupError, TypeError, ValueError)


class NamedNumbers:
    """A block of asserts; one that fails, or cannot be evaluated, is repeated with its values."""

    def __enter__(self) -> None:
        """Begin the block."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Raise an AssertionError with the statement and its numbers in place of a bare one."""
        if not isinstance(error, FAILURES) or trace is None:
            return
        reason = "no longer holds"
        if not isinstance(error, AssertionError):
            reason = f"cannot be evaluated any more ({type(error).__name__}: {error})"
        lines = "\n".join([f"this statement {reason}:", *_described(trace)])
        raise AssertionError(f"{lines}\nif you changed a parameter, this may do so") from error


def _described(trace: TracebackType) -> Iterator[str]:
    """Source of the assert at a line of a notebook, and the values that it compares."""
    frame = trace.tb_frame
    source = "".join(linecache.getlines(frame.f_code.co_filename, frame.f_globals))
    for statement in ast.walk(ast.parse(source)):
        is_it = isinstance(statement, ast.Assert) and (
            statement.lineno <= trace.tb_lineno <= (statement.end_lineno or 0)
        )
        if not is_it:
            continue
        yield f"    {ast.unparse(statement)}"
        for expression in _compared(statement.test):
            try:
                value = eval(expression, frame.f_globals, frame.f_locals)
            except (NameError, *FAILURES):  # a variable of a comprehension, or what has failed
                continue
            if _short(value) != expression:
                yield f"    {expression} is {_short(value)}"


def _compared(test: ast.expr) -> list[str]:
    """Expressions that a statement compares or goes through; all of it if there are none."""
    shown: list[ast.expr] = []
    for node in ast.walk(test):
        if isinstance(node, ast.Compare):
            shown += [node.left, *node.comparators]
        elif isinstance(node, ast.comprehension):
            shown.append(node.iter)
    if not shown:
        is_closeness = isinstance(test, ast.Call) and len(test.args) > 1
        shown = test.args[:2] if is_closeness else [test]
    expressions = [ast.unparse(one) for one in shown if not isinstance(one, ast.Constant)]
    return list(dict.fromkeys(expressions))


def _short(value: object) -> str:
    with np.printoptions(precision=6, threshold=20, edgeitems=4):
        text = " ".join(str(value).split())
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]} .."
