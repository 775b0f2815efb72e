"""Public names of a package, each imported from its module when it is first used.

The stub of the package says from which module. A function is checked here, at the door of the
package: what is inside calls what is inside.
"""

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import FunctionType


def names_of_stub(
    package: str, file: str
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package.

    `file` is its `__init__.py`, which has a stub beside it.
    """
    stub = ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8"))
    module_of: dict[str, str] = {}
    public_names: list[str] = []
    for statement in stub.body:
        if isinstance(statement, ast.ImportFrom):
            for alias in statement.names:
                module_of[alias.name] = str(statement.module)
        elif isinstance(statement, ast.Assign | ast.AugAssign):  # a part of __all__
            public_names += ast.literal_eval(statement.value)

    def get_attribute(name: str) -> object:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(module_of[name]), name)
        if isinstance(value, FunctionType):
            from pgo_models.errors import door

            value = door(value)
            value.__module__ = package  # where pickle finds it
        vars(sys.modules[package])[name] = value  # looked up once
        return value

    def list_names() -> list[str]:
        return sorted(public_names)

    return get_attribute, list_names, public_names
