"""Pictures of the matrices: the spectrum of S near zero, and the sparsity of M and of its Cholesky factor."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import eigsh

from pgo_models.certificates.certificate import Certificate
from pgo_models.certificates.spectrum import rotation_inverse, smallest_definite_shift
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, QUIET_COLOUR, SMALL_POINTS, column_figure, count_along_x
from pgo_models.problem.problem import PGOProblem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FIRST_SHIFT = 1e-6  # of the mean diagonal entry of M
_DENSE_SIDE = 200  # below it all eigenvalues are had at once
_CELLS = 300  # a side of the picture of a pattern


def smallest_eigenvalues(problem: PGOProblem, Lambda: Array, count: int = 12) -> Array:
    """Smallest eigenvalues of S with the translations marginalised, ascending, (count,).

    S_Q = S_RR - S_Rt S_tt^+ S_tR = Q - blockdiag(Lambda) acts on rotations alone, so that all its eigenvalues have the
    unit of kappa (per rad^2) and are those that eta shifts: S + eta blockdiag(0, I) is positive semidefinite if and
    only if lambda_min(S_Q) >= -eta. At a global optimum whose relaxation is tight d of them are zero. By shift-invert
    Lanczos below the spectrum: an estimate; the proof is `prove_bound`. A SettingError unless 1 <= count <= d n.
    """
    side = problem.num_poses * problem.d
    if not 1 <= count <= side:
        raise SettingError(f"count is {count}; S has {side} eigenvalues, give 1 to {side}")
    eta, factor = smallest_definite_shift(problem, Lambda, _FIRST_SHIFT * float(problem.M.diagonal().mean()))
    operator = rotation_inverse(problem, factor)
    if side <= _DENSE_SIDE or count >= side - 1:
        inverse = np.linalg.eigvalsh(operator @ np.eye(side))
    else:
        start = np.random.default_rng(0).standard_normal(side)  # only so that the same question has the same answer
        inverse = eigsh(operator, k=count, which="LA", v0=start, return_eigenvectors=False)
    return np.sort(1.0 / np.sort(inverse)[::-1][:count] - eta)


def plot_spectrum(problem: PGOProblem, certificate: Certificate, count: int = 12) -> Figure:
    """Figure of the smallest eigenvalues of S at the point of a certificate; see `smallest_eigenvalues`.

    Eigenvalues stand on a logarithmic axis, negative ones as vermilion triangles. The shaded band, where the
    proof needs an eta, is what that leaves open, |lambda| <= eta.
    """
    eigenvalues = smallest_eigenvalues(problem.tangent_at(certificate.poses), certificate.Lambda, count)
    k, negative = np.arange(1, count + 1), eigenvalues < 0
    with column_figure(height=0.8) as figure:
        axes = figure.add_subplot()
        axes.set_yscale("log")
        size = np.maximum(np.abs(eigenvalues), np.finfo(float).tiny)
        axes.plot(k[~negative], size[~negative], "o", color=COLOURS[0], label="positive")
        axes.plot(k[negative], size[negative], "v", color=ALARM_COLOUR, label="negative (size)")
        lowest = 0.3 * size.min()
        if certificate.eta > 0:
            lowest = min(lowest, 0.3 * certificate.eta)
            label = f"within eta = {certificate.eta:.1e}"
            axes.axhspan(lowest, certificate.eta, color=QUIET_COLOUR, alpha=0.3, linewidth=0, label=label)
        axes.set_ylim(bottom=lowest)
        axes.set_xlabel("k-th smallest eigenvalue of S")
        axes.set_ylabel("|eigenvalue| (per rad$^2$)")
        axes.set_title(f"{problem.graph.name}: gap {certificate.gap:.1e}, {certificate.verdict.name}")
        count_along_x(axes)
        figure.legend(loc="outside lower center", ncols=3, columnspacing=1.0, handletextpad=0.4)
    return figure


def factor_of_M(problem: PGOProblem) -> tuple[csc_array, IntArray]:
    """Cholesky factor L of M with its diagonal doubled, and the order, that of a solve; see `take_apart`."""
    data = problem.M.data.copy()
    data[problem.diagonal_positions] *= 2.0  # M itself is singular
    return problem.analysis.factorize(problem.with_pattern_of_M(data)).take_apart()


def plot_sparsity(problem: PGOProblem) -> Figure:
    """Figure of the patterns of M, in the order of the poses, and of its Cholesky factor, with the fill-in counted."""
    M, (L, _) = problem.M, factor_of_M(problem)
    fill_in = L.nnz - (M.nnz + problem.side) // 2
    with column_figure(height=0.6) as figure:
        left, right = figure.subplots(1, 2)
        _draw_pattern(left, M)
        _draw_pattern(right, L)
        left.set_title(f"M, {problem.side} x {problem.side}\n{M.nnz:,} entries")
        right.set_title(f"Cholesky factor\n{L.nnz:,} entries")
        share = 100.0 * fill_in / L.nnz
        figure.supxlabel(f"fill-in: {fill_in:,} entries, {share:.0f} % of the factor", fontsize=SMALL_POINTS)
    return figure


def _draw_pattern(axes: Axes, matrix: csc_array) -> None:
    """Draw the share of stored entries cell by cell; a cell is an entry while the matrix is small."""
    side, cells = matrix.shape[0], min(matrix.shape[0], _CELLS)
    columns = np.repeat(np.arange(side), np.diff(matrix.indptr))
    number = (matrix.indices * cells // side) * cells + columns * cells // side
    count = np.bincount(number, minlength=cells * cells).reshape(cells, cells)
    shown = np.where(count > 0, np.log1p(count), np.nan)
    shown_most = float(np.nanmax(shown))  # the lighter half of the colours is too faint for single cells
    axes.imshow(shown, cmap="cividis_r", extent=(0, side, side, 0), interpolation="nearest", vmin=-shown_most)
    axes.set_xticks([0, side])
    axes.set_yticks([0, side])
