"""Verify the lower bound of a model: by equations of its sets, or by their convex hulls."""

from pathlib import Path

from pgo_models.errors import FileFormatError
from pgo_models.verification.balls import arb, ctx, exact
from pgo_models.verification.hull_proof import hull_bound
from pgo_models.verification.model_proof import quadratic_bound
from pgo_models.verification.proof import MODEL_FORMAT, read_record
from pgo_models.verification.verification import MODEL, Verification

BITS = 128  # of the ball that the bound, a rational number, is printed as


def verify_model(path: Path) -> Verification:
    """What the proof of a model proves; `pgo_models.verify_proof` is its door."""
    record = read_record(path, MODEL_FORMAT)
    try:
        claim = exact(float(record["lower_bound"]))
        name = f"{path}: {len(record['variables'])} variables in sets, {len(record['c'])} numbers"
        bound, failure = (hull_bound if "cones" in record else quadratic_bound)(record)
    except (ValueError, KeyError, TypeError, IndexError, OverflowError) as error:
        raise FileFormatError(path, None, f"not a proof of a model: {error!r:.80}") from error
    if bound is not None and not claim <= bound:
        failure = "the claim: the lower bound that is claimed is above the proven one"
    with ctx.workprec(BITS):
        ball = None if bound is None else arb(bound)
    return Verification(name, MODEL, bound=ball, failure=failure)
