"""The sets of SOC, each with its projection.

They are orthonormal columns, SO(d), unit columns or rows, and arrays with few nonzeros. The
projection onto orthonormal columns is Theorem 1 of Lai & Osher 2014 and step (b) of the paper's
Algorithm 1.
"""

import functools
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from pgo_models.convex.prox import project_sparse, project_stiefel, project_unit_columns
from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.arrays import read_only
from pgo_models.geometry.rotations import Array, project_by_svd


class ConstraintSet(ABC):
    """A closed set of matrices with a projection: a user's own has `project`, and no more.

    A point P of the set, a matrix V beside it, a direction G or N and what is returned are arrays
    of the variable's shape, (k,) or (k, l).

    `OrthogonalProblem(problem, sets=[(X, MySet())])` puts a variable into it.

    Examples
    --------
    Vectors of whole numbers:

    >>> class Whole(ConstraintSet):
    ...     def project(self, V):
    ...         return np.round(V)
    >>> Whole().project(np.array([0.4, 1.7])).tolist()
    [0.0, 2.0]
    """

    def check_shape(self, shape: tuple[int, ...], name: str) -> None:
        """Raise a SettingError, which has the `name`, unless the set has matrices of this shape."""
        if len(shape) not in (1, 2):
            raise SettingError(f"{name} has shape {shape}; give a vector or a matrix")

    @abstractmethod
    def project(self, V: Array) -> Array:
        """Return a point of the set that is nearest to V, in the shape of V.

        Parameters
        ----------
        V : Array
            A vector or a matrix, in the shape of the variable.
        """

    def normal_part(self, P: Array, G: Array) -> Array:
        """Projection of G onto the normal space of the set at its point P.

        Here G itself. The multiplier rho B of SOC is normal at P as it is, because P is the
        projection of P + B.
        """
        return G

    def least_penalty(self, P: Array, N: Array) -> float:
        """Smallest rho at which P is still the projection of P + N / rho, for N normal at P.

        Here 0, which bounds nothing.
        """
        return 0.0

    def distance(self, P: Array) -> float:
        """How far P is from satisfying the equations of the set; here from its projection."""
        return float(np.linalg.norm(P - self.project(P)))

    def projected(self, V: Array) -> Array:
        """The projection, checked: a SettingError unless it has the shape of V and is finite."""
        P = np.asarray(self.project(V), dtype=float)
        if P.shape != V.shape or not np.isfinite(P).all():
            raise SettingError(
                f"{type(self).__name__}.project returned an array of shape {P.shape} for one of "
                f"shape {V.shape}; give finite numbers in its shape"
            )
        return P

    def random(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        """Random point of the set: the projection of normal entries.

        Its distribution is uniform for orthonormal columns, rotations and unit vectors.
        """
        normal_entries = rng.standard_normal(shape)
        return self.projected(normal_entries)


@dataclass(frozen=True)
class Orthonormal(ConstraintSet):
    """X^T X = I, columns at most as many as rows: the Stiefel manifold; O(p) when X is square."""

    def check_shape(self, shape: tuple[int, ...], name: str) -> None:
        """Two dimensions, not more columns than rows."""
        if len(shape) != 2 or shape[1] > shape[0]:
            raise SettingError(
                f"{name} has shape {shape}; "
                "X^T X = I needs at least as many rows as columns: transpose"
            )

    def project(self, V: Array) -> Array:
        """U V^T of the SVD."""
        return project_stiefel(V)

    def normal_part(self, P: Array, G: Array) -> Array:
        """P Lambda, with Lambda = sym(P^T G)."""
        Lambda = _symmetric(P.T @ G)
        return np.asarray(P @ Lambda)

    def least_penalty(self, P: Array, N: Array) -> float:
        """Largest eigenvalue of -Lambda, with N = P Lambda.

        The polar factor of P (I + Lambda / rho) must be P.
        """
        Lambda = _symmetric(P.T @ N)
        smallest = np.linalg.eigvalsh(Lambda)[0]
        return max(0.0, float(-smallest))

    def tangent_basis(self, P: Array) -> Array:
        """Orthonormal basis of the tangent space, one direction a column, entries column-major.

        It is P Omega + P_perp K with Omega skew.
        """
        n, p = P.shape
        skew = (_skew_basis(p) @ P.T).reshape(-1, n * p)
        if n == p:
            return np.asarray(skew.T)
        P_perp = np.linalg.qr(P, mode="complete")[0][:, p:]
        outside = np.kron(np.eye(p), P_perp.T)
        return np.concatenate([skew, outside]).T

    def tangent_part(self, P: Array, basis: Array, M: Array) -> Array:
        """basis^T M for the tangent basis at P, and M of any number of columns."""
        n, p = P.shape
        if n > p:
            return np.asarray(basis.T @ M)
        products = P.T @ M.reshape(p, n, -1)  # of column i of P and of column j of M at j, i
        first, second = np.triu_indices(p, 1)
        return np.asarray(np.sqrt(0.5) * (products[second, first] - products[first, second]))

    def times_multiplier(self, P: Array, G: Array, directions: Array) -> Array:
        """V Lambda for all directions V, the columns of an (n p, k) array, Lambda = sym(P^T G).

        The Hessian of the Lagrangian along V is that of J less this.
        """
        Lambda = _symmetric(P.T @ G)
        by_column = directions.reshape(P.shape[1], -1)
        return np.asarray((Lambda @ by_column).reshape(directions.shape))

    def distance(self, P: Array) -> float:
        """||P^T P - I||_F."""
        gram = P.T @ P
        identity = np.eye(len(gram))
        return float(np.linalg.norm(gram - identity))


@dataclass(frozen=True)
class Rotations(Orthonormal):
    """X^T X = I and det X = 1: SO(d), for square X of any side.

    It is a part of O(d), and has the same normal spaces.
    """

    def check_shape(self, shape: tuple[int, ...], name: str) -> None:
        """Raise a SettingError unless the shape is square."""
        if len(shape) != 2 or shape[0] != shape[1]:
            raise SettingError(
                f"{name} has shape {shape}; "
                "a rotation must be square, use `orthogonal` for X^T X = I"
            )

    def project(self, V: Array) -> Array:
        """U diag(1, .., 1, det(U V^T)) V^T of the SVD."""
        return project_by_svd(V)

    def least_penalty(self, P: Array, N: Array) -> float:
        """Minus the mean of Lambda's two smallest eigenvalues.

        P (I + Lambda / rho) may have one negative singular value and still be nearest to P.
        """
        Lambda = _symmetric(P.T @ N)
        two_smallest = np.linalg.eigvalsh(Lambda)[:2]
        return max(0.0, float(-np.mean(two_smallest)))

    def distance(self, P: Array) -> float:
        """max(||P^T P - I||_F, 1 - det P)."""
        not_orthogonal = super().distance(P)
        determinant = float(np.linalg.det(P))
        return max(not_orthogonal, 1.0 - determinant)


@dataclass(frozen=True)
class UnitColumns(ConstraintSet):
    """||x_j|| = 1 for every column x_j; a vector is one column."""

    def _columns(self, V: Array) -> Array:
        """V with the vectors that have unit norm as its columns; applied twice it gives V again."""
        return V

    def project(self, V: Array) -> Array:
        """Every column over its norm; a zero column becomes the first unit vector."""
        projected = project_unit_columns(self._columns(V))
        return self._columns(projected).reshape(V.shape)

    def normal_part(self, P: Array, G: Array) -> Array:
        """P diag(Lambda), with Lambda_j = <p_j, g_j>."""
        Lambda = self._products(P, G)
        columns = self._columns(P) * Lambda
        return self._columns(columns).reshape(P.shape)

    def least_penalty(self, P: Array, N: Array) -> float:
        """Largest -Lambda_j, with N = P diag(Lambda)."""
        Lambda = self._products(P, N)
        return max(0.0, float(-np.min(Lambda)))

    def tangent_part(self, P: Array, basis: Array, M: Array) -> Array:
        """As `Orthonormal.tangent_part`."""
        return np.asarray(basis.T @ M)

    def times_multiplier(self, P: Array, G: Array, directions: Array) -> Array:
        """As `Orthonormal.times_multiplier`, with Lambda = diag(<p_j, g_j>)."""
        Lambda = np.broadcast_to(self._products(P, G), self._columns(P).shape)
        weights = self._columns(Lambda).reshape(-1, order="F")
        return np.asarray(weights[:, None] * directions)

    def tangent_basis(self, P: Array) -> Array:
        """As `Orthonormal.tangent_basis`: what is orthogonal to each of the vectors."""
        counted = np.arange(float(P.size)).reshape(P.shape, order="F")
        places = self._columns(counted).astype(int)
        vectors = self._columns(P).reshape(len(places), -1)
        bases = []
        for vector, place in zip(vectors.T, places.reshape(vectors.shape).T, strict=True):
            basis = np.zeros((P.size, len(vector) - 1))
            basis[place] = np.linalg.qr(vector[:, None], mode="complete")[0][:, 1:]
            bases.append(basis)
        return np.concatenate(bases, axis=1)

    def distance(self, P: Array) -> float:
        """Norm of the vector of ||p_j||^2 - 1."""
        squared_norms = self._products(P, P)
        return float(np.linalg.norm(squared_norms - 1.0))

    def _products(self, P: Array, G: Array) -> Array:
        """<p_j, g_j> of all columns."""
        products = self._columns(P) * self._columns(G)
        return np.asarray(np.sum(products, axis=0))


@dataclass(frozen=True)
class UnitRows(UnitColumns):
    """||x_i|| = 1 for every row x_i; of a vector, every entry is -1 or 1."""

    def _columns(self, V: Array) -> Array:
        if V.ndim == 1:
            return V.reshape(1, -1)
        return V.T


@dataclass(frozen=True)
class Sparse(ConstraintSet):
    """At most `nonzeros` entries are not zero: ||X||_0 <= nonzeros."""

    nonzeros: int

    def __post_init__(self) -> None:
        check_settings(self, at_least_one=["nonzeros"])

    def project(self, V: Array) -> Array:
        """Hard thresholding: the largest entries are kept; of equal ones the first."""
        return project_sparse(V, self.nonzeros)

    def normal_part(self, P: Array, G: Array) -> Array:
        """G off the support of P; 0 where P has room for another nonzero."""
        if np.count_nonzero(P) < self.nonzeros:
            return np.zeros(P.shape)
        return np.where(P == 0, G, 0.0)

    def least_penalty(self, P: Array, N: Array) -> float:
        """Return 0, which bounds nothing.

        The bound would be the largest |N| off the support over the smallest |P| on it. Both can
        jump from one iterate to the next, so that rho cannot follow it.
        """
        return 0.0


def _symmetric(A: Array) -> Array:
    return 0.5 * (A + A.T)


@functools.cache
def _skew_basis(p: int) -> Array:
    """Orthonormal basis of the transposed skew (p, p) matrices, (p (p - 1) / 2, p, p)."""
    above = np.triu_indices(p, 1)
    basis = np.zeros((len(above[0]), p, p))
    number = np.arange(len(above[0]))
    basis[number, above[1], above[0]] = np.sqrt(0.5)
    basis[number, above[0], above[1]] = -np.sqrt(0.5)
    return read_only(basis)
