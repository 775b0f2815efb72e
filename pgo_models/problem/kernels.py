"""Choice of the BLAS kernels that CHOLMOD runs in CVXOPT.

The wheel of CVXOPT contains an OpenBLAS of 2021, which does not recognise later CPUs and runs its
SSE3 kernels on them. The environment variable OPENBLAS_CORETYPE names the kernels to use instead.
OpenBLAS reads it once, when it is loaded: numpy and scipy are loaded before, and the OpenBLAS of
either keeps its kernels. Other kernels use fused multiply-adds and sum in another order, which
changes the last bits of a factor. The bounds on its error hold for any order, with or without fused
multiply-adds (`pgo_models.problem.floating_point`).
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from scipy.linalg.lapack import dpotrf

from pgo_models.memory import check_room

VARIABLE = "OPENBLAS_CORETYPE"
_BUFFER = 2**26  # bytes: twice the size of the buffer of OpenBLAS
# Kernels for AVX2; those for AVX-512 are as fast.
_KERNELS = "Haswell"
# Names of AVX2 in `numpy.show_config`, of older and newer versions.
_AVX2 = {"AVX2", "X86_V3"}


def chosen_kernels() -> str | None:
    """Kernels that OpenBLAS is asked for: the user's, else those for AVX2.

    The result is None if the CPU has no AVX2: then OpenBLAS chooses.
    """
    extensions = np.show_config(mode="dicts").get("SIMD Extensions", {})
    baseline = extensions.get("baseline", ())
    detected = extensions.get("found", ())
    has_avx2 = not _AVX2.isdisjoint([*baseline, *detected])
    default = _KERNELS if has_avx2 else None
    return os.environ.get(VARIABLE, default)


def take_buffers() -> None:
    """Make the OpenBLAS of numpy and that of scipy allocate their buffers now.

    A MemoryError is raised where there is not enough memory. OpenBLAS itself, if it finds no memory
    at its first call, tries again in a loop that no signal ends.
    """
    for factorize in (np.linalg.cholesky, dpotrf):
        check_room(_BUFFER)
        factorize(np.eye(1))


@contextmanager
def kernels_of_the_cpu() -> Iterator[None]:
    """Within the context, an OpenBLAS that CVXOPT loads runs `chosen_kernels`.

    The environment is restored afterwards.
    """
    is_loaded = "cvxopt" in sys.modules
    is_chosen_by_user = VARIABLE in os.environ
    kernels = None if is_loaded or is_chosen_by_user else chosen_kernels()
    if kernels:
        os.environ[VARIABLE] = kernels
    try:
        yield
    finally:
        if kernels:
            del os.environ[VARIABLE]
