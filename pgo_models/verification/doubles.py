"""What doubles can tell of the cost of poses: how far a solver's figure may be from the exact cost.

It decides whether the cost that a proof claims counts as that of its poses. It is computed from the
measurements and the poses alone, never from a claim, and no bound depends on it.

The cost of an edge is the square of a norm of its residuals, a translation r and a rotation by
theta. In doubles r has an error in proportion to the lengths that it is the difference of, and the
rotation one in proportion to 1. With the traces w_t of I_tt and w_R of I_rr, the square of the norm
of these errors is at most

    n^2 = RESIDUAL_SHARE^2 (w_t (||t_j - t_i||^2 + ||t_ij||^2) + w_R),

so that all costs together, C, change by at most 2 sqrt(C sum n^2) + sum n^2 (Cauchy-Schwarz).

The weights have errors, too, `WEIGHT_SHARE`. A relative error of the entries of I changes r^T I r
by that share of the size w_t ||r||^2 + w_R 2 (1 - cos theta), which is far above the cost of an
ill-conditioned edge along its weak direction. It is the same for F: a relative error of the entries
of A changes tr(A^-1) by that share of tr(A) tr(A^-1)^2 at most, and so tau ||r||^2 by that share of
d w_t ||r||^2. A matrix I that is the inverse of a covariance C has an error of its own. Scaled to
ones on the diagonal of C, a relative error of the entries of C is one of I, multiplied by tr(C)
tr(I).
"""

from dataclasses import dataclass, field

from pgo_models.verification.balls import arb, arb_mat, fmpq, part, symmetric
from pgo_models.verification.costs import (
    information_side,
    rotation_residual,
    translation_residual,
)
from pgo_models.verification.measurements import Edge
from pgo_models.verification.proof import ROTATION_COSTS, UNIT_COSTS

# 8,192 roundings of a double: of a rotation that a solver keeps, which may be 128 of them from its
# own inverse, multiplied by what follows from it.
RESIDUAL_SHARE = arb(2) ** -40
# 2,048 roundings: 256 are added to the diagonal of a matrix that is semidefinite but for rounding,
# and a sum in chi2 with coupling blocks has up to 1,152.
WEIGHT_SHARE = arb(2) ** -42


@dataclass(eq=False)
class Resolution:
    """Sums over the edges of what doubles cannot tell, for one cost."""

    cost: str
    squares: arb = field(default_factory=arb)  # of n / RESIDUAL_SHARE
    sizes: arb = field(default_factory=arb)

    def add_edge(self, edge: Edge, X: dict[int, arb_mat]) -> None:
        """Add what doubles cannot tell of the residuals of an edge at X."""
        w_t, w_R = self._weights(edge)
        X_i = X[edge.i]
        X_j = X[edge.j]
        first_row = range(1)
        columns = range(edge.tag.d)
        difference = part(X_j, first_row, columns) - part(X_i, first_row, columns)
        r = translation_residual(edge, X_i, X_j)
        squared_lengths = squared_norm(difference) + squared_norm(edge.t)
        self.squares += w_t * squared_lengths + w_R
        size = w_t * squared_norm(r)
        if w_R != 0:
            E = rotation_residual(edge.R, X_i, X_j)
            size += w_R * (edge.tag.d - E.trace())
        self.sizes += size * amplification(edge)

    def of(self, objective: arb) -> arb:
        """Bound on the distance of the cost in doubles from this exact one."""
        n_squared = (RESIDUAL_SHARE * RESIDUAL_SHARE * self.squares).upper()
        cross = (objective.upper().max(arb(0)) * n_squared).sqrt()
        return 2 * cross + n_squared + WEIGHT_SHARE * self.sizes

    def _weights(self, edge: Edge) -> tuple[fmpq, fmpq]:
        """Sums w_t and w_R of the weights of an edge."""
        d = edge.tag.d
        rows = symmetric(edge.triangle, information_side(d, edge.tag.is_point))
        diagonal = [row[a] for a, row in enumerate(rows)]
        w_t = sum(diagonal[:d], fmpq(0))
        w_R = sum(diagonal[d:], fmpq(0))
        if self.cost in UNIT_COSTS:
            w_t = fmpq(w_t != 0)
            w_R = fmpq(w_R != 0)
        if self.cost in ROTATION_COSTS:
            w_t = fmpq(0)
        return w_t, w_R


def squared_norm(A: arb_mat) -> arb:
    """Sum of the squares of all entries."""
    return sum((entry * entry for entry in A.entries()), arb(0))


def amplification(edge: Edge) -> fmpq:
    """What a relative error of the numbers of the file can be multiplied by: 1, or tr(C) tr(I)."""
    if not edge.covariance:
        return fmpq(1)
    side = edge.tag.side
    C = symmetric(edge.covariance, side)
    information = symmetric(edge.triangle, side)
    return side * sum((C[a][a] * information[a][a] for a in range(side)), fmpq(0))
