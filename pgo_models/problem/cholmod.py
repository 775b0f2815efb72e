"""CHOLMOD and AMD as CVXOPT has them, with its options set for a while, and its matrices."""

import sys
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
from pgo_models.memory import check_room
from pgo_models.problem.kernels import kernels_of_the_cpu

_OPTIONS = RLock()
_ROOM_TO_IMPORT = 2**28  # bytes of address space that the libraries and the buffer of OpenBLAS take
# bytes that CVXOPT, which crashes where it gets none, takes to sort an entry into a matrix
_ROOM_FOR_AN_ENTRY = 100


def lower_triangle(pattern: csc_array) -> tuple[Any, IntArray, BoolArray]:
    """CVXOPT's matrix of ones on a lower triangle.

    With it come the positions of its entries in the pattern, and which of them are diagonal.
    """
    cvxopt, _ = import_cvxopt()
    check_room(_ROOM_FOR_AN_ENTRY * len(pattern.indices))
    columns = np.repeat(np.arange(pattern.shape[1], dtype=np.int32), np.diff(pattern.indptr))
    lower = np.flatnonzero(pattern.indices >= columns)
    places = [of_all[lower].astype(np.int64) for of_all in (pattern.indices, columns)]
    return (
        cvxopt.spmatrix(1.0, *map(cvxopt.matrix, places), pattern.shape),
        lower,
        places[0] == places[1],
    )


@contextmanager
def supernodal() -> Iterator[ModuleType]:
    """CHOLMOD set to L L^T, which exists for positive definite matrices only.

    To analyse for L D L^T accepts others.
    """
    _, cholmod = import_cvxopt()
    with set_option(cholmod, "supernodal", 2):
        yield cholmod


@contextmanager
def set_option(cholmod: ModuleType, name: str, value: int) -> Iterator[None]:
    """An option of CHOLMOD for a while, in which other threads wait: there is one set of them."""
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
    if "cvxopt.base" not in sys.modules:
        check_room(_ROOM_TO_IMPORT)
    with kernels_of_the_cpu():
        cvxopt = extra_module("cvxopt", "fast")
        cholmod = extra_module("cvxopt.cholmod", "fast")
    # Where OpenBLAS gets no memory for its buffer it crashes: it has it before a large matrix takes
    # all.
    extra_module("cvxopt.lapack", "fast").potrf(cvxopt.matrix(1.0))
    return cvxopt, cholmod


def amd_order(pattern: csc_array) -> IntArray:
    """Order of elimination by approximate minimum degree (Amestoy, Davis & Duff 2004), (N,)."""
    import_cvxopt()  # on the kernels chosen
    from cvxopt import amd

    return np.array(amd.order(lower_triangle(pattern)[0])).ravel().astype(np.int64)
