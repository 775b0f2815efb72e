"""Public names of a package, each imported from its module when it is first used: its stub says from which."""

import ast
import importlib
from collections.abc import Callable
from pathlib import Path


def names_of_stub(package: str, file: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package whose `__init__.py`, `file`, has a stub beside it."""
    stub = ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8")).body
    modules = {one.name: node.module for node in stub if isinstance(node, ast.ImportFrom) for one in node.names}
    lists = [ast.literal_eval(node.value) for node in stub if isinstance(node, ast.Assign | ast.AugAssign)]

    def attribute(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(str(modules[name])), name)

    return attribute, lambda: sorted(modules), [name for names in lists for name in names]
