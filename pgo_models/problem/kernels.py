"""BLAS kernels of CVXOPT's CHOLMOD.

Its wheel brings an OpenBLAS of 2021, which runs SSE3 on CPUs that came later.

OpenBLAS knows CPUs by their model, and looks at OPENBLAS_CORETYPE once, as it is loaded: those of
numpy and scipy, loaded before, keep what they chose. Fused multiply-adds and sums in another order
change the last bits of a factor; the bounds on its error are for any order, with or without them
(`pgo_models.problem.floating_point`).
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from scipy.linalg.lapack import dpotrf

from pgo_models.memory import check_room

VARIABLE = "OPENBLAS_CORETYPE"
_BUFFER = 2**26  # bytes: twice what is taken
# those for AVX-512 are as fast; numpy says AVX2 by either name
_KERNELS = "Haswell"
_NEEDED = {"AVX2", "X86_V3"}


def chosen_kernels() -> str | None:
    """Kernels that OpenBLAS is asked for: the user's, else those for AVX2.

    None, which leaves it its own, where the CPU has no AVX2.
    """
    has = np.show_config(mode="dicts").get("SIMD Extensions", {})
    has_needed = not _NEEDED.isdisjoint([*has.get("baseline", ()), *has.get("found", ())])
    return os.environ.get(VARIABLE, _KERNELS if has_needed else None)


def take_buffers() -> None:
    """Have the OpenBLAS of numpy and that of scipy take the memory that they work in.

    A MemoryError is raised without it.

    Where there is none when they first need it, they ask again and again, and no signal ends that.
    """
    for factorize in (np.linalg.cholesky, dpotrf):
        check_room(_BUFFER)
        factorize(np.eye(1))


@contextmanager
def kernels_of_the_cpu() -> Iterator[None]:
    """Have an OpenBLAS that CVXOPT loads meanwhile run `chosen_kernels`.

    The environment is as before afterwards.
    """
    kernels = None if "cvxopt" in sys.modules or VARIABLE in os.environ else chosen_kernels()
    if kernels:
        os.environ[VARIABLE] = kernels
    try:
        yield
    finally:
        if kernels:
            del os.environ[VARIABLE]
