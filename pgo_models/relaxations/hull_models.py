"""The relaxation with the convex hull of SO(3) at every edge: its dual as a cvxpy model.

    primal   min tr(Q Z)                  Z_ii = I, Z PSD, A(Z_ij) PSD at every edge (i, j)
    dual     max sum tr Lambda_i - sum tr Pi_e     Pi_e PSD,
             M - blockdiag(0, Lambda) - sum_e N(Pi_e) PSD

A and N are those of `pgo_models.relaxations.rotation_hull`. The relaxation without A admits mirror
images of rotations, too. For rotation averaging with anisotropic costs the same hull is added by
Olsson, Lochman, Malmport & Zach (2025).
"""

from dataclasses import dataclass

import cvxpy as cp
import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.problem import PGOProblem
from pgo_models.relaxations.primal_dual import (
    DualRelaxation,
    dual_relaxation,
)
from pgo_models.relaxations.rotation_hull import (
    PRODUCTS,
    edges_of,
    less_diagonal_blocks,
    terms_of,
)


@dataclass(frozen=True, eq=False)
class DualHullRelaxation(DualRelaxation):
    """The dual with a multiplier Pi for every edge.

    Parameters
    ----------
    edges : (k, 2) array of int
        The poses of every pair with a multiplier.
    multipliers : list of (4, 4) cp.Variable
        Pi_e / scale.
    """

    edges: IntArray
    multipliers: list[cp.Variable]

    def Lambda(self) -> Array:
        """Multipliers, (n, d, d), of the cost less the terms, as solved."""
        return less_diagonal_blocks(super().Lambda(), self.terms())

    def terms(self) -> HandednessTerms:
        """The handedness terms of the multipliers Pi, as solved."""
        values = np.stack([variable.value for variable in self.multipliers])
        return terms_of(self.edges, self.scale * values)


def dual_hull_relaxation(problem: PGOProblem) -> DualHullRelaxation:
    """Pose the dual as one sparse linear matrix inequality, beside a small cone for every edge."""
    plain = dual_relaxation(problem)
    edges = edges_of(problem)
    multipliers = [cp.Variable((4, 4), name=f"Pi_{e}", PSD=True) for e in range(len(edges))]
    stacked = cp.hstack([cp.reshape(Pi, (16,), order="C") for Pi in multipliers])
    side = plain.certificate.args[0].shape[0]
    coupling = cp.reshape(_coupling_blocks(edges, side) @ stacked, (side, side), order="F")
    certificate = (plain.certificate.args[0] - coupling) >> 0
    trace = sum(cp.trace(Pi) for Pi in multipliers)
    model = cp.Problem(cp.Maximize(plain.model.objective.args[0] - trace), [certificate])
    return DualHullRelaxation(
        problem, model, plain.upper, certificate, plain.scale, edges, multipliers
    )


def _coupling_blocks(edges: IntArray, side: int) -> csc_array:
    """The matrix that takes all Pi, (16 k,), to sum_e N(Pi_e), its columns stacked.

    The block (i, j) of N is half of sum_ab <Pi, C_ab> e_a e_b^T, and (j, i) its transpose; the
    rotations of pose i have the rows n - 1 + 3 i of a matrix without the row of t_0.
    """
    num_translations = (side - 3) // 4
    a, b, c, d = np.nonzero(PRODUCTS)
    values = 0.5 * PRODUCTS[a, b, c, d]
    row = num_translations + 3 * edges[:, :1] + a
    column = num_translations + 3 * edges[:, 1:] + b
    entry = 16 * np.arange(len(edges))[:, None] + 4 * c + d
    weights = np.broadcast_to(values, entry.shape).ravel()
    places = np.concatenate([(row + side * column).ravel(), (column + side * row).ravel()])
    entries = np.tile(entry.ravel(), 2)
    return csc_array((np.tile(weights, 2), (places, entries)), shape=(side * side, 16 * len(edges)))
