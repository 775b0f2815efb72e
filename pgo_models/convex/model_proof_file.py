"""Write the proof of a model's lower bound: the model's numbers, its sets, and the multipliers."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array, triu

from pgo_models.certificates.proof_file import write_proof
from pgo_models.convex.constraint_sets import Orthonormal, Rotations, UnitRows
from pgo_models.convex.hull_bound import HullBound
from pgo_models.convex.model_bound import ModelBound
from pgo_models.convex.quadratic_form import Block, QuadraticForm
from pgo_models.convex.set_equations import equations_of_block
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array

FORMAT = "pgo-splitting model proof 1"


def write_model_proof(form: QuadraticForm, bound: ModelBound, path: Path | str) -> None:
    """Write a proof that `verify_proof` checks; the file is written whole or not at all."""
    _check_sets(form.blocks)
    start = 0
    further = sum(len(equations_of_block(block)[0]) for block in form.blocks)
    variables = []
    for block, first in zip(form.blocks, form.first_entries, strict=True):
        basic, others = equations_of_block(block)
        of_basic = bound.multipliers[start : start + len(basic)]
        of_others = bound.multipliers[further : further + len(others)]
        start += len(basic)
        further += len(others)
        variables.append(_variable(block, first, of_basic, of_others))
    record: dict[str, Any] = {
        "format": FORMAT,
        "P": _entries(coo_array(triu(form.P))),
        "c": form.c.tolist(),
        "A": _entries(coo_array(form.A)),
        "b": form.b.tolist(),
        "H": _entries(coo_array(form.H)),
        "h": form.h.tolist(),
        "constant": form.constant,
        "variables": variables,
        "products": [
            {"of": product.of, "P": bound.multipliers[product.entries].tolist()}
            for product in bound.equations.products
        ],
        "lower_bound": bound.value,
    }
    if form.gauge is not None:
        record["held"] = {
            "variable": form.gauge.block,
            "turned": "from the left" if form.gauge.is_left else "from the right",
            "entries": form.w_columns[form.gauge.entries].tolist(),
        }
    write_proof(record, path)


def write_hull_proof(bound: HullBound, path: Path | str) -> None:
    """As `write_model_proof`, of the bound by hulls: the convex program and its dual point.

    Nothing is written of unit vectors and of rotations of the plane: the least value of a linear
    function is known there.
    """
    program = bound.program
    _check_sets(program.blocks)
    dims = program.dims_of_model
    matrices = program.semidefinite(bound.y)[len(dims.psd) :]
    variables = []
    for block in program.blocks:
        variable = _set_of(block, block.start)
        if isinstance(block.sets[0], Orthonormal):
            P = matrices.pop(0)
            if not block.is_plane:
                variable["P"] = P[np.triu_indices(len(P))].tolist()
        variables.append(variable)
    record = {
        "format": FORMAT,
        "c": program.c.tolist(),
        "A": _entries(coo_array(program.A[program.of_model])),
        "b": program.b[program.of_model].tolist(),
        "constant": program.constant,
        "cones": {name: getattr(dims, name) for name in ("zero", "nonneg", "soc", "psd")},
        "variables": variables,
        "y": bound.y[program.of_model].tolist(),
        "lower_bound": bound.value,
    }
    write_proof(record, path)


def _check_sets(blocks: Sequence[Block]) -> None:
    if any(len(block.sets) > 1 for block in blocks):
        raise SettingError("no proof to write: a variable is in several sets")


def _set_of(block: Block, first: int) -> dict[str, Any]:
    """A variable without its multipliers."""
    kind = block.sets[0]
    shape = block.shape if len(block.shape) == 2 else (block.shape[0], 1)
    if isinstance(kind, Orthonormal):
        name = "rotation" if isinstance(kind, Rotations) else "orthonormal"
    else:
        name = "unit rows" if isinstance(kind, UnitRows) else "unit columns"
    return {"shape": list(shape), "first": int(first), "sets": [name]}


def _variable(block: Block, first: int, basic: Array, others: Array) -> dict[str, Any]:
    """A variable, its sets, and the multipliers of its equations in their order."""
    kind = block.sets[0]
    variable = _set_of(block, first)
    multipliers = {}
    if block.is_plane:
        multipliers["unit columns"] = basic.tolist()
    elif isinstance(kind, Orthonormal):
        multipliers["columns"] = basic.tolist()
        n, p = block.shape if len(block.shape) == 2 else (block.size, 1)
        num_rows = n * (n + 1) // 2 - 1 if n == p else 0
        multipliers["rows"] = others[:num_rows].tolist()
        multipliers["cross" if n == 3 else "minors"] = others[num_rows:].tolist()
    else:
        multipliers[variable["sets"][0]] = basic.tolist()
    multipliers = {key: values for key, values in multipliers.items() if values}
    return variable | {"multipliers": multipliers}


def _entries(matrix: coo_array) -> list[list[float]]:
    rows = zip(matrix.row.tolist(), matrix.col.tolist(), matrix.data.tolist(), strict=True)
    return [list(entry) for entry in rows]
