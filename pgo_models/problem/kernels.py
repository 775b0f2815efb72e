"""BLAS kernels of CVXOPT's CHOLMOD: its wheel brings an OpenBLAS of 2021, which runs SSE3 on CPUs that came later.

OpenBLAS knows CPUs by their model, and looks at OPENBLAS_CORETYPE once, as it is loaded: those of numpy and scipy,
loaded before, keep what they chose. Fused multiply-adds and sums in another order change the last bits of a factor; the
bounds on its error are for any order, with or without them (`pgo_models.problem.floating_point`).
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

VARIABLE = "OPENBLAS_CORETYPE"
_KERNELS, _NEEDED = "Haswell", {"AVX2", "X86_V3"}  # those for AVX-512 are as fast; numpy says AVX2 by either name


def chosen_kernels() -> str | None:
    """Kernels that OpenBLAS is asked for: the user's, else those for AVX2 where the CPU has it; else None, its own."""
    has = np.show_config(mode="dicts").get("SIMD Extensions", {})
    has_needed = not _NEEDED.isdisjoint([*has.get("baseline", ()), *has.get("found", ())])
    return os.environ.get(VARIABLE, _KERNELS if has_needed else None)


@contextmanager
def kernels_of_the_cpu() -> Iterator[None]:
    """Have an OpenBLAS that CVXOPT loads meanwhile run `chosen_kernels`; the environment is as before afterwards."""
    kernels = None if "cvxopt" in sys.modules or VARIABLE in os.environ else chosen_kernels()
    if kernels:
        os.environ[VARIABLE] = kernels
    try:
        yield
    finally:
        if kernels:
            del os.environ[VARIABLE]
