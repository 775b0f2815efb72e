"""The checks at the end of a notebook: an assert that fails says which number moved."""

import ast
import linecache
from collections.abc import Iterator
from types import TracebackType

import numpy as np

MOST_CHARACTERS = 200  # of a value that is shown


class NamedNumbers:
    """A block of asserts; one that fails is repeated with the values of what it compares."""

    def __enter__(self) -> None:
        """Begin the block."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Raise an AssertionError with the statement and its numbers in place of a bare one."""
        if isinstance(error, AssertionError) and trace is not None:
            lines = "\n".join(["this statement no longer holds:", *_described(trace)])
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
            except NameError:  # a variable of a comprehension
                continue
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
