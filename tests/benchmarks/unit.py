"""The unit u of published timings: seconds for one fixed sparse factorisation on this machine."""

import statistics
import time

import numpy as np
from scipy.sparse import csc_array, diags_array, eye_array, kron
from scipy.sparse.linalg import splu

SIDE = 22


def seconds_of_unit(repeats: int = 7) -> float:
    """Median time to factor and solve the 7-point Laplacian of a 22 x 22 x 22 grid, shifted by
    0.01, with SuperLU.
    """
    eye = eye_array(SIDE)
    path = diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(SIDE, SIDE))
    grid = kron(kron(path, eye), eye) + kron(kron(eye, path), eye) + kron(kron(eye, eye), path)
    matrix = csc_array(grid + 0.01 * eye_array(SIDE**3))
    return statistics.median(_seconds(matrix) for _ in range(repeats))


def _seconds(matrix: csc_array) -> float:
    start = time.perf_counter()
    factor = splu(
        matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options={"SymmetricMode": True}
    )
    factor.solve(np.ones((SIDE**3, 3)))
    return time.perf_counter() - start
