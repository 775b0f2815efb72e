"""CHOLMOD and AMD of CVXOPT, with its matrices and its options."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import RLock
from types import ModuleType
from typing import Any

import numpy as np
from scipy.sparse import csc_array

from pgo_models.errors import extra_module
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.pose_graph import IntArray

_OPTIONS = RLock()


def lower_triangle(pattern: csc_array) -> tuple[Any, IntArray, BoolArray]:
    """CVXOPT's matrix of ones on the lower triangle of a pattern, real or complex as that is.

    Returned as well are the positions of its entries in the pattern, and which are diagonal.
    """
    cvxopt, _ = import_cvxopt()
    every_column = np.arange(pattern.shape[1], dtype=np.int32)
    columns = np.repeat(every_column, np.diff(pattern.indptr))
    lower = np.flatnonzero(pattern.indices >= columns)
    lower_rows = pattern.indices[lower].astype(np.int64)
    lower_columns = columns[lower].astype(np.int64)
    one = 1.0 + 0.0j if np.iscomplexobj(pattern.data) else 1.0
    matrix = cvxopt.spmatrix(
        one, cvxopt.matrix(lower_rows), cvxopt.matrix(lower_columns), pattern.shape
    )
    return matrix, lower, lower_rows == lower_columns


@contextmanager
def supernodal() -> Iterator[ModuleType]:
    """CHOLMOD with the option for L L^T, which exists for positive definite matrices only.

    Without it CHOLMOD may factor other matrices as L D L^T.
    """
    _, cholmod = import_cvxopt()
    with set_option(cholmod, "supernodal", 2):
        yield cholmod


@contextmanager
def set_option(cholmod: ModuleType, name: str, value: int) -> Iterator[None]:
    """Set an option of CHOLMOD within the context. Other threads wait, as all share the options."""
    with _OPTIONS:
        saved = dict(cholmod.options)
        cholmod.options[name] = value
        try:
            yield
        finally:
            cholmod.options.clear()
            cholmod.options.update(saved)


@cache
def import_cvxopt() -> tuple[ModuleType, ModuleType]:
    """CVXOPT and its CHOLMOD; a MissingExtraError without the extra `fast`."""
    return extra_module("cvxopt", "fast"), extra_module("cvxopt.cholmod", "fast")


def amd_order(pattern: csc_array) -> IntArray:
    """Order of elimination by approximate minimum degree (Amestoy, Davis & Duff 2004), (N,)."""
    amd = extra_module("cvxopt.amd", "fast")
    matrix, _, _ = lower_triangle(pattern)
    order = np.array(amd.order(matrix)).ravel()
    return order.astype(np.int64)
