"""Write the proof of a model's lower bound: the model's numbers, its sets, and the multipliers."""

from pathlib import Path
from typing import Any

from scipy.sparse import coo_array, triu

from pgo_models.certificates.proof_file import write_proof
from pgo_models.convex.constraint_sets import Orthonormal, Rotations, UnitRows
from pgo_models.convex.model_bound import ModelBound
from pgo_models.convex.quadratic_form import Block, QuadraticForm
from pgo_models.convex.set_equations import equations_of_block
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array

FORMAT = "pgo-splitting model proof 1"


def write_model_proof(form: QuadraticForm, bound: ModelBound, path: Path | str) -> None:
    """Write a proof that `verify_proof` checks; the file is written whole or not at all."""
    if any(len(block.sets) > 1 for block in form.blocks):
        raise SettingError("no proof to write: a variable is in several sets")
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
        "constant": form.constant,
        "variables": variables,
        "products": [
            {"of": product.of, "P": bound.multipliers[product.entries].tolist()}
            for product in bound.products
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


def _variable(block: Block, first: int, basic: Array, others: Array) -> dict[str, Any]:
    """A variable, its sets, and the multipliers of its equations in their order."""
    kind = block.sets[0]
    shape = block.shape if len(block.shape) == 2 else (block.shape[0], 1)
    multipliers = {}
    if block.is_plane:
        name, multipliers["unit columns"] = "rotation", basic.tolist()
    elif isinstance(kind, Orthonormal):
        name = "rotation" if isinstance(kind, Rotations) else "orthonormal"
        multipliers["columns"] = basic.tolist()
        num_rows = len(others) - (9 if isinstance(kind, Rotations) and shape == (3, 3) else 0)
        multipliers["rows"] = others[:num_rows].tolist()
        multipliers["cross"] = others[num_rows:].tolist()
    else:
        name = "unit rows" if isinstance(kind, UnitRows) else "unit columns"
        multipliers[name] = basic.tolist()
    multipliers = {key: values for key, values in multipliers.items() if values}
    return {"shape": list(shape), "first": first, "sets": [name], "multipliers": multipliers}


def _entries(matrix: coo_array) -> list[list[float]]:
    rows = zip(matrix.row.tolist(), matrix.col.tolist(), matrix.data.tolist(), strict=True)
    return [list(entry) for entry in rows]
