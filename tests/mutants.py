"""Mutation testing of what a proof rests on: small defects that the tests must notice.

Each mutant replaces one piece of text in a copy of the project and runs the tests that should fail
then. A mutant whose tests pass all the same has survived: those tests do not hold what they are
there to hold.

    python tests/mutants.py                      all mutants
    python tests/mutants.py --sample 6 --seed 3  six of them, drawn at random
    python tests/mutants.py slack growth         those whose name contains a word

It prints one line a mutant and exits with 1 if one survived. `tests/test_mutants.py` holds that
every text that is to be replaced still stands exactly once in its file.
"""

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
COPIED = ("pgo_models", "solvers", "tests", "data", "pyproject.toml")
KILLED_BY_PYTEST = 1  # exit code of a run in which a test failed


@dataclass(frozen=True)
class Mutant:
    """One defect: `old` becomes `new` in `file`, and one of `tests` must fail."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


BOUNDS = (
    "tests/certificates/test_what_is_subtracted.py",
    "tests/certificates/test_error_formulas.py",
    "tests/certificates/test_prove_bound.py",
)
MUTANTS = (
    # Priors far from zero.
    Mutant(
        "far priors: positions are moved though that rounds them",
        "pgo_models/problem/local_world.py",
        "return np.where(is_exact, point, 0.0)",
        "return point",
        ("tests/problem/test_local_world.py",),
    ),
    Mutant(
        "far priors: poses in another frame count as moved without rounding",
        "pgo_models/certificates/certificate.py",
        "if not local.keeps_exactly(poses):",
        "if local is None:",
        ("tests/test_far_priors.py",),
    ),
    Mutant(
        "far priors: what far coordinates do not explain counts as their rounding",
        "pgo_models/certificates/fit.py",
        "coordinates = UNIT_ROUNDOFF * (size[graph.i] + size[graph.j] + lengths)",
        "coordinates = 1e2 * UNIT_ROUNDOFF * (size[graph.i] + size[graph.j] + lengths)",
        ("tests/test_far_priors.py",),
    ),
    Mutant(
        "far priors: the verifier moves the world pose and its measurements apart",
        "pgo_models/verification/verify.py",
        "moved = [p + t for p, t in",
        "moved = [p - t for p, t in",
        ("tests/verification/test_world_at_zero.py",),
    ),
    # Rotations alone.
    Mutant(
        "rotations alone: translations of given poses cost something",
        "pgo_models/problem/rotation_averaging.py",
        "if not poses.t.any():",
        "if poses.t.any():",
        ("tests/problem/test_rotation_averaging.py",),
    ),
    Mutant(
        "rotations alone: the padding is in the proof",
        "pgo_models/certificates/lower_bound.py",
        "rows = np.union1d(np.arange(n), rows)",
        "rows = np.union1d(rows, rows)",
        ("tests/problem/test_rotation_averaging.py",),
    ),
    Mutant(
        "verify: the translation weights of F are left in its rotation part",
        "pgo_models/verification/costs.py",
        "        tau = fmpq(0)\n    kappas",
        "        tau = tau * 1\n    kappas",
        ("tests/verification/test_verify.py",),
    ),
    # The verifier.
    Mutant(
        "verify: rotations are at most sqrt(2) apart",
        "pgo_models/verification/verify.py",
        "FARTHEST = 8 ",
        "FARTHEST = 2 ",
        ("tests/verification/test_verify.py",),
    ),
    Mutant(
        "verify: handedness terms are zero at the poses of the proof",
        "pgo_models/verification/verify.py",
        "value_at_X -= subtract_terms(",
        "subtract_terms(",
        ("tests/verification/test_verify.py",),
    ),
    Mutant(
        "verify: a zero pivot with entries beside it counts as semidefinite",
        "pgo_models/verification/balls.py",
        "if pivot == 0 and any(beside_pivot):",
        "if False:",
        ("tests/verification/test_costs.py", "tests/verification/test_verify.py"),
    ),
    Mutant(
        "verify: a landmark may have a rotation",
        "pgo_models/verification/verify.py",
        "if proof.R.keys() != graph.nodes - graph.landmarks:",
        "if False:",
        ("tests/verification/test_proof_files.py",),
    ),
    Mutant(
        "verify: any node may be grounded",
        "pgo_models/verification/verify.py",
        "if proof.ground not in proof.R:",
        "if False:",
        ("tests/verification/test_proof_files.py",),
    ),
    Mutant(
        "verify: what is a hundredth off a rotation is one",
        "pgo_models/verification/verify.py",
        "NO_ROTATION = 1e-6",
        "NO_ROTATION = 1e-2",
        ("tests/verification/test_costs.py",),
    ),
    Mutant(
        "verify: a form that is not the cost goes unnoticed",
        "pgo_models/verification/verify.py",
        "if not value_at_X.overlaps(objective):",
        "if False:",
        ("tests/verification/test_verify.py",),
    ),
    # The lower bound, central and by robots.
    Mutant(
        "robots: the rounding of the separators' own entries is not counted",
        "solvers/distributed/lower_bound.py",
        " + 8.0 * UNIT_ROUNDOFF * diagonal",
        "",
        ("tests/distributed/robots/test_exact_robots.py",),
    ),
    Mutant(
        "robots: slack is found where rounding takes all of the margin",
        "solvers/distributed/robots/proof.py",
        "if (2.0 * error <= shift).all():",
        "if True:",
        ("tests/certificates/test_what_is_subtracted.py",),
    ),
    Mutant(
        "robots: entries of any size are in range",
        "solvers/distributed/robots/proof.py",
        "if len(inside) and not is_in_range(S.data, diagonal[inside]):",
        "if False:",
        ("tests/certificates/test_what_is_subtracted.py",),
    ),
    Mutant(
        "robots: rounding is a share of a diagonal that terms make negative",
        "solvers/distributed/robots/proof.py",
        "size = np.maximum(diagonal, np.abs(problem.M.data[problem.diagonal_positions]))",
        "size = diagonal",
        ("tests/certificates/test_what_is_subtracted.py",),
    ),
    Mutant(
        "robots: translations stay where a proof moves",
        "solvers/distributed/robots/proof.py",
        "low=self.low - step[:p]",
        "low=self.low",
        ("tests/certificates/test_error_formulas.py",),
    ),
    Mutant(
        "robots: the tangent's constant is exact in the form with eta",
        "solvers/distributed/robots/proof_orders.py",
        "constant, -constant_error, -lost",
        "constant, -lost",
        ("tests/distributed/robots/test_exact_robots.py",),
    ),
    Mutant(
        "robots: the tangent's constant is not in the form with eta",
        "solvers/distributed/robots/proof_orders.py",
        "constant, -constant_error, -lost",
        "-constant_error, -lost",
        ("tests/distributed/robots/test_exact_robots.py",),
    ),
    Mutant(
        "robots: no robot leaves out the translation of pose 0",
        "solvers/distributed/robots/proof_orders.py",
        "        fixed = np.append(fixed, 0)\n",
        "        pass\n",
        (
            "tests/distributed/robots/test_exact_robots.py",
            "tests/distributed/test_bound_by_robots.py",
        ),
    ),
    Mutant(
        "robots: multipliers of the driver of any size are in range",
        "solvers/distributed/lower_bound.py",
        "    if not is_in_range(added, diagonal):\n        return None\n",
        "",
        ("tests/distributed/robots/test_exact_robots.py",),
    ),
    Mutant(
        "robots: a bound with terms and an eta does not name the terms",
        "solvers/distributed/lower_bound.py",
        "replace(found, terms=_collect_terms(driver)) if found.value > 0.0 else found",
        "found",
        ("tests/distributed/test_terms_by_robots.py",),
    ),
    Mutant(
        "rotations are taken to be no more than 1 apart",
        "pgo_models/certificates/lower_bound.py",
        "apart = math.sqrt(8.0) +",
        "apart = 1.0 +",
        BOUNDS,
    ),
    Mutant(
        "an eta costs nothing in a bound grounded at a pose",
        "pgo_models/certificates/lower_bound.py",
        "return bound_from([value, -lost], value_error",
        "return bound_from([value], value_error",
        BOUNDS,
    ),
    Mutant(
        "an eta costs nothing in a bound without poses",
        "pgo_models/certificates/lower_bound.py",
        "[*traces, constant, -lost]",
        "[*traces, constant]",
        BOUNDS,
    ),
    Mutant(
        "the rounding of the value is not subtracted",
        "pgo_models/certificates/lower_bound.py",
        "[value, -lost], value_error + quadratic",
        "[value, -lost], quadratic",
        BOUNDS,
    ),
    Mutant(
        "the rows of the grounded pose are left as they were computed",
        "pgo_models/certificates/lower_bound.py",
        "    X[rows] = np.concatenate([np.zeros((1, d)), np.eye(d)])\n",
        "",
        BOUNDS,
    ),
    Mutant(
        "weights of any size count as safe",
        "pgo_models/certificates/lower_bound.py",
        "np.isfinite(Lambda).all() and has_safe_scale(problem)",
        "np.isfinite(Lambda).all()",
        BOUNDS,
    ),
    Mutant(
        "robots: weights of any size count as safe",
        "solvers/distributed/robots/proof.py",
        "if not has_safe_scale(problem):",
        "if False:",
        BOUNDS,
    ),
    Mutant(
        "a bound above F is not a defect",
        "pgo_models/certificates/certificate.py",
        "if bound.value > F + rounding.error:",
        "if False:",
        ("tests/certificates/test_what_is_subtracted.py", "tests/certificates/test_certificate.py"),
    ),
    # Positive definiteness.
    Mutant(
        "slack is found where rounding takes all of the margin",
        "pgo_models/certificates/definiteness.py",
        "if (2.0 * error <= self.margin).all()",
        "if (error <= 2.0 * self.margin).all()",
        BOUNDS,
    ),
    Mutant(
        "the diagonal that rounding is a share of is that of the stored entries",
        "pgo_models/certificates/definiteness.py",
        "np.maximum(problem.M.data[positions], stored) + shifts",
        "stored",
        (*BOUNDS, "tests/certificates/test_exact_bounds.py"),
    ),
    Mutant(
        "the shift is not added to that diagonal",
        "pgo_models/certificates/definiteness.py",
        "np.maximum(problem.M.data[positions], stored) + shifts",
        "np.maximum(problem.M.data[positions], stored)",
        (*BOUNDS, "tests/certificates/test_exact_bounds.py"),
    ),
    Mutant(
        "the rounding of the entries of S is not counted",
        "pgo_models/certificates/definiteness.py",
        "error = OUTWARD * (self.entries + factor_error)",
        "error = OUTWARD * (0.0 * self.entries + factor_error)",
        BOUNDS,
    ),
    # Cholesky factors and floating point.
    Mutant(
        "a pivot that is nan counts as one",
        "pgo_models/problem/floating_point.py",
        "if not (np.isfinite(pivots).all() and (pivots > 0.0).all()):",
        "if (pivots <= 0.0).any():",
        ("tests/problem/test_cholesky.py", *BOUNDS),
    ),
    Mutant(
        "a pivot that is not positive counts as one",
        "pgo_models/problem/floating_point.py",
        "if not (np.isfinite(pivots).all() and (pivots > 0.0).all()):",
        "if not np.isfinite(pivots).all():",
        ("tests/problem/test_cholesky.py", *BOUNDS),
    ),
    Mutant(
        "an error formula forgets how many non-zeros a row has",
        "pgo_models/problem/floating_point.py",
        "OUTWARD * most_in_row * each / (1.0",
        "OUTWARD * each / (1.0",
        ("tests/certificates/test_error_formulas.py", "tests/problem/test_cholesky.py"),
    ),
    Mutant(
        "three roundings beside the sum are forgotten",
        "pgo_models/problem/floating_point.py",
        "each = gamma(in_column + 3.0)",
        "each = gamma(in_column)",
        ("tests/certificates/test_error_formulas.py", "tests/problem/test_cholesky.py"),
    ),
    # Weights.
    Mutant(
        "a tangent loses nothing to rounding",
        "pgo_models/problem/excess.py",
        "OUTWARD * 32.0 * (share * length) ** 2 * sizes",
        "0.0 * sizes",
        ("tests/certificates/test_tangent_formulas.py", "tests/certificates/test_tangent.py"),
    ),
    Mutant(
        "a tangent's value is exact",
        "pgo_models/problem/excess.py",
        "return OUTWARD * share * length**2",
        "return 0.0 * length",
        ("tests/certificates/test_tangent_formulas.py", "tests/certificates/test_tangent.py"),
    ),
    Mutant(
        "tau is all of the smallest eigenvalue",
        "pgo_models/problem/weighting.py",
        "self.smallest - 2.0 * self.margin",
        "self.smallest",
        ("tests/problem/test_weighting.py", "tests/certificates/test_tangent_formulas.py"),
    ),
    Mutant(
        "the error of W costs nothing in the value of an edge",
        "pgo_models/problem/edge_cost.py",
        "value_error += of_value",
        "value_error += 0.0 * of_value",
        ("tests/certificates/test_tangent_formulas.py",),
    ),
    Mutant(
        "the error of W costs nothing in S X",
        "pgo_models/problem/edge_cost.py",
        "G_error[:, 1:] += of_product",
        "G_error[:, 1:] += 0.0 * of_product",
        ("tests/certificates/test_tangent_formulas.py",),
    ),
    Mutant(
        "the gradient of a tangent in the rotations counts as exact",
        "pgo_models/problem/information_costs.py",
        "at_beginning(term_errors)",
        "at_beginning(0.0 * self.own_error)",
        ("tests/certificates/test_tangent_formulas.py",),
    ),
    # Rounding errors of the entries, of S X and of F.
    Mutant(
        "rotations of the measurements count as exact in the entries of S",
        "pgo_models/certificates/rounding_errors.py",
        "slant = float(orthogonality_error(graph.R_ij).max()) + d * gamma(d + 2)",
        "slant = 0.0",
        ("tests/certificates/test_rounding_errors.py", "tests/certificates/test_error_formulas.py"),
    ),
    Mutant(
        "the rounding of residuals is not counted in S X",
        "pgo_models/certificates/rounding_errors.py",
        "errors = gamma(d) * product_sizes + UNIT_ROUNDOFF * np.abs(delta)",
        "errors = UNIT_ROUNDOFF * np.abs(delta)",
        ("tests/certificates/test_rounding_errors.py", "tests/certificates/test_error_formulas.py"),
    ),
    # Handedness terms.
    Mutant(
        "handedness: what rounding makes of T and P is not subtracted",
        "pgo_models/certificates/handedness.py",
        "return OUTWARD * float(np.sum(of_T + of_P))",
        "return 0.0",
        ("tests/certificates/test_handedness.py",),
    ),
    Mutant(
        "handedness: a third of the loss of T is all of it",
        "pgo_models/certificates/handedness.py",
        "of_T = 3.0 * slant",
        "of_T = 1.0 * slant",
        ("tests/certificates/test_handedness.py",),
    ),
    Mutant(
        "handedness: T^T T - I is computed without rounding",
        "pgo_models/certificates/handedness.py",
        " + 3.0 * gamma(5.0)",
        "",
        ("tests/certificates/test_handedness.py",),
    ),
    Mutant(
        "handedness: the eigenvalues of P are computed without rounding",
        "pgo_models/certificates/handedness.py",
        "[:, 0] - _EIGENVALUE_ERROR * UNIT_ROUNDOFF * P_size",
        "[:, 0]",
        ("tests/certificates/test_handedness.py",),
    ),
    Mutant(
        "handedness: negative eigenvalues of P stay",
        "pgo_models/certificates/handedness.py",
        "np.maximum(values[chosen], 0.0)",
        "values[chosen]",
        ("tests/certificates/test_handedness.py",),
    ),
    Mutant(
        "handedness: T is taken as it is given",
        "pgo_models/certificates/handedness.py",
        "project_to_rotations(T[chosen])",
        "T[chosen]",
        ("tests/certificates/test_handedness.py",),
    ),
    Mutant(
        "handedness: closed forms make another direction negative",
        "pgo_models/certificates/handedness.py",
        "np.where(lacking < room, lacking + 0.25 * (room - lacking), room)",
        "(lacking + 0.25 * (room - lacking))",
        ("tests/certificates/test_handedness.py",),
    ),
    Mutant(
        "handedness: the difference of bound and loss may be rounded up",
        "pgo_models/certificates/lower_bound.py",
        "math.nextafter(found.value - lost, -math.inf)",
        "found.value - lost",
        ("tests/certificates/test_handedness.py",),
    ),
    Mutant(
        "handedness: landmarks have pairs, too",
        "pgo_models/certificates/handedness.py",
        "    turns = ~np.isin(graph.j, graph.landmarks)\n    ends",
        "    turns = np.ones(graph.num_edges, dtype=bool)\n    ends",
        ("tests/certificates/test_handedness.py",),
    ),
    Mutant(
        "handedness: a P with an eigenvalue below zero counts as semidefinite",
        "pgo_models/certificates/handedness.py",
        "of_P = np.maximum(0.0, -least)",
        "of_P = 0.0 * least",
        ("tests/certificates/test_handedness.py",),
    ),
    Mutant(
        "handedness: half of the trace is the whole",
        "pgo_models/certificates/handedness.py",
        'half_trace = 0.5 * np.einsum("kaa->k", P)',
        'half_trace = np.einsum("kaa->k", P)',
        ("tests/certificates/test_handedness.py",),
    ),
    Mutant(
        "handedness: the loss is not taken off the bound",
        "pgo_models/certificates/lower_bound.py",
        "value = math.nextafter(found.value - lost, -math.inf)",
        "value = found.value",
        ("tests/certificates/test_handedness.py",),
    ),
    Mutant(
        "handedness by robots: the loss is not in the error of the value",
        "solvers/distributed/robots/proof.py",
        "value_error=at_X.value_error + OUTWARD * lost",
        "value_error=at_X.value_error",
        ("tests/certificates/test_handedness.py",),
    ),
    Mutant(
        "handedness by robots: the loss is not in the trace of the form with eta",
        "solvers/distributed/robots/proof_orders.py",
        "        lost = terms.loss()\n",
        "",
        ("tests/distributed/test_terms_by_robots.py",),
    ),
    Mutant(
        "handedness: the verifier takes any P",
        "pgo_models/verification/verify.py",
        "if not is_semidefinite(symmetric(triangle, 3)):",
        "if False:",
        ("tests/verification/test_verify.py",),
    ),
    # Robots with files of their own, and graphs that grow.
    Mutant(
        "own files: poses are moved to their frame without rounding",
        "solvers/distributed/robots_with_files.py",
        "self.kept.append(replace(kept, objective=objective, rounding=rounding))",
        "self.kept.append(replace(kept, objective=objective))",
        ("tests/distributed/test_own_files.py",),
    ),
    Mutant(
        "own files: one robot's exact part makes the whole exact",
        "solvers/distributed/robots_with_files.py",
        "Fit.of_all(part.fit for part in parts)",
        "Fit.of_all(part.fit for part in parts[:1])",
        ("tests/distributed/test_own_files.py",),
    ),
    Mutant(
        "own files: the error of one robot's cost is that of all",
        "solvers/distributed/robots_with_files.py",
        "error = math.fsum(part.error for part in parts)",
        "error = parts[0].error",
        ("tests/distributed/test_own_files.py",),
    ),
    Mutant(
        "own files: the frame is that of the first robot",
        "solvers/distributed/robots_with_files.py",
        "key=lambda answer: (not answer.held[0], answer.held[1])",
        "key=lambda answer: not answer.held[0]",
        ("tests/distributed/test_own_files.py",),
    ),
    Mutant(
        "own files: a file fixes poses of other robots",
        "solvers/distributed/robots/own_file.py",
        "fixed = np.flatnonzero(is_own & np.isin(ids, lines.fixed))",
        "fixed = np.flatnonzero(np.isin(ids, lines.fixed))",
        ("tests/distributed/test_own_files.py",),
    ),
    Mutant(
        "own files: rotations are tied by weights of translations",
        "solvers/distributed/robots/own_file.py",
        "(graph.tau >= 0, graph.tau > 0, graph.kappa > 0)",
        "(graph.tau >= 0, graph.tau > 0, graph.tau > 0)",
        ("tests/distributed/test_own_files.py",),
    ),
    Mutant(
        "own files: positions are tied by edges without a weight",
        "solvers/distributed/robots/own_file.py",
        "(graph.tau >= 0, graph.tau > 0, graph.kappa > 0)",
        "(graph.tau >= 0, graph.tau >= 0, graph.kappa > 0)",
        ("tests/distributed/test_own_files.py",),
    ),
    Mutant(
        "own files: landmarks are taken for poses",
        "solvers/distributed/robots/own_file.py",
        "if len(lines.landmarks) or (lines.edge_ids == WORLD_ID).any():",
        "if (lines.edge_ids == WORLD_ID).any():",
        ("tests/distributed/test_own_files.py",),
    ),
    Mutant(
        "growing: measurements of old edges are not compared",
        "solvers/growing.py",
        "if own is not None and not np.array_equal(own, other[old]):",
        "if False:",
        ("tests/test_growing.py",),
    ),
    Mutant(
        "growing: a cost that is not convex is taken",
        "solvers/growing.py",
        "cost.is_quadratic and cost.is_convex and cost.has_translations",
        "cost.is_quadratic and cost.has_translations",
        ("tests/test_growing.py",),
    ),
    Mutant(
        "growing: information matrices that come or go are not compared",
        "solvers/growing.py",
        "        if (own is None) != (other is None):\n            return None\n",
        "",
        ("tests/test_growing.py",),
    ),
    Mutant(
        "growing: ids of old poses are not compared",
        "solvers/growing.py",
        "    if not np.array_equal(graph.pose_ids[:n], before.pose_ids):\n        return None\n",
        "",
        ("tests/test_growing.py",),
    ),
    Mutant(
        "growing: an update that was interrupted is followed by another solve",
        "solvers/growing.py",
        "if not update.is_open:",
        "if not update.proof.can_improve:",
        ("tests/test_growing.py",),
    ),
    Mutant(
        "growing: priors are taken for edges",
        "solvers/growing.py",
        "if len(graph.landmarks) or graph.world is not None:",
        "if len(graph.landmarks):",
        ("tests/test_growing.py",),
    ),
    # Elsewhere.
    Mutant(
        "multipliers of sets other than X^T X = I have the wrong sign",
        "pgo_models/convex/orthogonality.py",
        "isinstance(term.constraint, Orthonormal) else -normal",
        "isinstance(term.constraint, Orthonormal) else normal",
        ("tests/convex/test_orthogonality.py",),
    ),
    Mutant(
        "robots: a shift that was too small is tried smaller",
        "solvers/riemannian/newton_step.py",
        "SHIFT_GROWTH * order.eta))",
        "SHIFT_GROWTH / max(order.eta, 1e-300)))",
        ("tests/distributed/test_distributed_newton.py",),
    ),
    Mutant(
        "a matrix on the edge of definiteness counts as definite",
        "pgo_models/graphs/precisions.py",
        "LEAST_SCALED = 1e-12",
        "LEAST_SCALED = 0.0",
        ("tests/graphs/test_precisions.py", "tests/problem/test_thresholds.py"),
    ),
)


def copy_project(folder: Path) -> None:
    """Put what the tests need into a folder."""
    ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=ignored)
        else:
            shutil.copy(ROOT / name, folder / name)


def is_killed(mutant: Mutant, folder: Path) -> bool:
    """Whether a test fails in the copy of the project that has the mutant in it.

    The copy is mended again.
    """
    path = folder / mutant.file
    text = path.read_text(encoding="utf-8")
    if text.count(mutant.old) != 1:
        raise SystemExit(
            f"{mutant.file} has {text.count(mutant.old)} times, not once: {mutant.old!r}"
        )
    path.write_text(text.replace(mutant.old, mutant.new), encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        command = [sys.executable, "-m", "pytest", "-q", "-x", *mutant.tests]
        ended = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
    finally:
        path.write_text(text, encoding="utf-8")
    if ended.returncode not in (0, KILLED_BY_PYTEST):
        raise SystemExit(
            f"{mutant.name}: pytest ended with {ended.returncode}\n{ended.stdout}{ended.stderr}"
        )
    return ended.returncode == KILLED_BY_PYTEST


def chosen_mutants(words: list[str], sample: int | None, seed: int) -> list[Mutant]:
    """Mutants whose names contain one of the words, if any are given.

    So many of them are drawn at random, if that is asked for.
    """
    chosen = [one for one in MUTANTS if not words or any(word in one.name for word in words)]
    return (
        chosen if sample is None else random.Random(seed).sample(chosen, min(sample, len(chosen)))
    )


def main() -> None:
    """Apply the mutants that are asked for and report survivors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument(
        "words", nargs="*", help="parts of the names of mutants; all mutants without"
    )
    parser.add_argument("--sample", type=int, help="draw so many of them at random")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    arguments = parser.parse_args()
    survivors = 0
    with tempfile.TemporaryDirectory() as scratch:
        copy_project(Path(scratch))
        for mutant in chosen_mutants(arguments.words, arguments.sample, arguments.seed):
            killed = is_killed(mutant, Path(scratch))
            survivors += not killed
            print(
                f"{'killed  ' if killed else 'SURVIVED'}  {mutant.file}: {mutant.name}", flush=True
            )
    print(f"{survivors} survived")
    raise SystemExit(1 if survivors else 0)


if __name__ == "__main__":
    main()
