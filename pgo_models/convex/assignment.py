"""Multipliers of X^T X = I and X X^T <= I together, in closed form: trace(A X N X^T) and its like.

Let x^T Q x be the part of J in one variable X with n rows and p columns, x = vec X. With Lambda and
W as multipliers of columns and of rows, the Lagrangian has Q - Lambda x I + I x W, where x is the
Kronecker product, W is any symmetric matrix if n = p, and positive semidefinite if n > p. Therefore
Q counts up to such terms, and if the rest is N x A, eigenvectors of A and N make all diagonal:

    nu_i alpha_j - lambda_i + w_j >= 0,    w_j >= 0 if n > p, and 0 where j is not assigned,

which is the dual of assigning an alpha to every nu. The best assignment sorts them, nu downwards
(with n - p zeros) and alpha upwards, and w_j - w_(j+1) = s_j (alpha_(j+1) - alpha_j) is a dual
solution for any s_j from nu_(j+1) to nu_j. This proves Brockett's and the orthogonal quadratic
assignment problem exactly, and that of Procrustes with a square X, of which a linear J is left.

Hoffman & Wielandt 1953; Overton & Womersley 1993; Anstreicher & Wolkowicz 2000.
"""

import numpy as np

from pgo_models.convex.constraint_sets import Orthonormal
from pgo_models.convex.quadratic_form import QuadraticForm
from pgo_models.convex.set_equations import ONE, SetEquations, Terms, equations_of_block
from pgo_models.geometry.rotations import Array

_ROUNDING = 1e-10  # share of Q up to which the rest is a Kronecker product
_DEFINITE = 1e-12  # what is added to W, as a share of its largest eigenvalue
_LARGEST = 1000  # entries of X, whose Q is dense here


def assignment_multipliers(
    form: QuadraticForm, equations: SetEquations
) -> tuple[SetEquations, Array] | None:
    """Multipliers of rows, all others 0, and the equations with W; None where there are none."""
    has_more = form.num_constrained < form.side - 1 or not form.is_free[:-1].all()
    if has_more or form.limits_x:
        return None
    of_rows = []  # entries of the multipliers of square variables, and their values
    products = []
    values_of_products = []
    start = equations.num_basic
    for place, block in enumerate(form.blocks):
        further = start
        start += len(equations_of_block(block)[1])
        if not isinstance(block.sets[0], Orthonormal) or block.is_plane or block.size > _LARGEST:
            continue
        coordinates = block.coordinates
        W = _row_multipliers(form.Q[coordinates][:, coordinates].toarray(), block.shape)
        if W is None:
            continue
        upper = np.triu_indices(len(W))
        if block.shape[0] == block.shape[1]:  # the last norm of a row is no equation
            W = W - W[-1, -1] * np.eye(len(W))
            columns, rows = np.tril_indices(len(W))
            values = np.where(rows == columns, -1.0, -2.0)[:-1] * W[rows, columns][:-1]
            of_rows.append((slice(further, further + len(values)), values))
        else:
            products.append((((place, 0),), len(W), _outside(block.start, block.shape)))
            values_of_products.append(W[upper])
    if not of_rows and not products:
        return None
    with_rows = equations.with_products(products)
    multipliers = np.zeros(with_rows.number)
    for entries, values in of_rows:
        multipliers[entries] = values
    for product, values in zip(with_rows.products, values_of_products, strict=True):
        multipliers[product.entries] = values
    return with_rows, multipliers


def _row_multipliers(Q: Array, shape: tuple[int, ...]) -> Array | None:
    """W, or None where the rest of Q is no Kronecker product of symmetric matrices."""
    n, p = shape
    rest = Q.reshape(p, n, p, n)
    rest = rest - np.einsum("bada,ce->bcde", rest, np.eye(n)) / n
    W = np.zeros((n, n))
    if n == p:
        W = -np.einsum("babc->ac", rest) / p
        rest = rest + np.einsum("bd,ac->badc", np.eye(p), W)
    realigned = rest.transpose(0, 2, 1, 3).reshape(p * p, n * n)
    largest = realigned[np.argmax(np.linalg.norm(realigned, axis=1))]
    A = largest.reshape(n, n)
    N = (realigned @ largest / (largest @ largest or 1.0)).reshape(p, p)
    left = realigned - np.outer(N.reshape(-1), largest)
    allowed = _ROUNDING * np.linalg.norm(Q)
    if max(np.linalg.norm(left), np.linalg.norm(N) * np.linalg.norm(A - A.T)) > allowed:
        return None
    alpha, vectors = np.linalg.eigh(A)
    nu = np.sort(np.concatenate([np.linalg.eigvalsh(N), np.zeros(n - p)]))[::-1]
    steps = 0.5 * (nu[:-1] + nu[1:]) * np.diff(alpha)
    w = np.append(np.cumsum(steps[::-1])[::-1], 0.0)
    if n > p:
        w -= w[np.argmin(abs(nu))]
        w = np.maximum(w, 0.0) + _DEFINITE * (abs(w).max() or 1.0)
    return np.asarray(W + (vectors * w) @ vectors.T)


def _outside(start: int, shape: tuple[int, ...]) -> list[Terms]:
    """The upper triangle of I - X X^T, row by row; off the diagonal twice."""
    n, p = shape
    terms: list[Terms] = []
    for a in range(n):
        terms.append([(ONE, ONE, 1.0), *((start + a + n * c,) * 2 + (-1.0,) for c in range(p))])
        for b in range(a + 1, n):
            terms.append([(start + a + n * c, start + b + n * c, -2.0) for c in range(p)])
    return terms
