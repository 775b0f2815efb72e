"""Figures of the matrices: the spectrum of S near zero, and the sparsity of M and of its factor."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import eigsh

from pgo_models.certificates.certificate import Certificate
from pgo_models.certificates.spectrum import rotation_inverse, smallest_definite_shift
from pgo_models.errors import SettingError
from pgo_models.figures import rounded_up
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.plots.style import (
    ALARM_COLOUR,
    COLOURS,
    QUIET_COLOUR,
    SMALL_POINTS,
    column_figure,
    count_along_x,
)
from pgo_models.problem.problem import PGOProblem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FIRST_SHIFT = 1e-6  # as a share of the mean diagonal entry of M
_DENSE_SIDE = 200  # up to this side of S all eigenvalues are computed by a dense method
_CELLS = 300  # along a side of the picture of a pattern


def smallest_eigenvalues(problem: PGOProblem, Lambda: Array, count: int = 12) -> Array:
    """Smallest eigenvalues of S with the translations marginalised, ascending, (count,).

    S_Q = S_RR - S_Rt S_tt^+ S_tR = Q - blockdiag(Lambda) acts on rotations alone, so that all its
    eigenvalues have the unit of kappa (per rad^2) and are those that eta shifts: S + eta
    blockdiag(0, I) is positive semidefinite if and only if lambda_min(S_Q) >= -eta. At a global
    optimum whose relaxation is tight, d of them are zero. They are computed by shift-invert
    Lanczos, with a shift below the spectrum. This is an estimate; the proof is `prove_bound`. A
    SettingError unless 1 <= count <= d n.
    """
    side = problem.num_poses * problem.d
    if not 1 <= count <= side:
        raise SettingError(f"count is {count}; S has {side} eigenvalues, give 1 to {side}")
    first_shift = _FIRST_SHIFT * float(problem.M.diagonal().mean())
    eta, factor = smallest_definite_shift(problem, Lambda, first_shift)
    operator = rotation_inverse(problem, factor)
    if side <= _DENSE_SIDE or count >= side - 1:
        inverse = np.linalg.eigvalsh(operator @ np.eye(side))
    else:
        # A fixed start makes the result the same in every run.
        start = np.random.default_rng(0).standard_normal(side)
        inverse = eigsh(operator, k=count, which="LA", v0=start, return_eigenvectors=False)
    largest_inverse = np.sort(inverse)[::-1][:count]
    return np.sort(1.0 / largest_inverse - eta)


def plot_spectrum(problem: PGOProblem, certificate: Certificate, count: int = 12) -> Figure:
    """Figure of the `smallest_eigenvalues` of S at the point of a certificate.

    Eigenvalues stand on a logarithmic axis, negative ones as vermilion triangles. Where the proof
    needs an eta, a shaded band shows what it leaves open, |lambda| <= eta. With handedness terms S
    is the matrix less them, as in the proof.
    """
    tangent = problem.tangent_at(certificate.poses)
    terms = certificate.bound.terms
    if terms is not None:
        tangent = terms.taken_off(tangent)
    eigenvalues = smallest_eigenvalues(tangent, certificate.Lambda, count)
    k = np.arange(1, count + 1)
    is_negative = eigenvalues < 0
    with column_figure(height=0.8) as figure:
        axes = figure.add_subplot()
        axes.set_yscale("log")
        smallest_number = np.finfo(float).tiny  # a logarithmic axis shows no zeros
        size = np.maximum(np.abs(eigenvalues), smallest_number)
        marks = [
            (~is_negative, "o", COLOURS[0], "positive"),
            (is_negative, "v", ALARM_COLOUR, "negative (size)"),
        ]
        for chosen, marker, colour, label in marks:
            axes.plot(k[chosen], size[chosen], marker, color=colour, label=label)
        lowest = 0.3 * size.min()
        if certificate.eta > 0:
            lowest = min(lowest, 0.3 * certificate.eta)
            label = f"within eta = {rounded_up(certificate.eta, 2)}"
            axes.axhspan(
                lowest, certificate.eta, color=QUIET_COLOUR, alpha=0.3, linewidth=0, label=label
            )
        axes.set_ylim(bottom=lowest)
        axes.set_xlabel("k-th smallest eigenvalue of S")
        axes.set_ylabel("|eigenvalue| (per rad$^2$)")
        gap = rounded_up(certificate.printed_gap, 2)
        axes.set_title(f"{problem.graph.name}: gap {gap}, {certificate.verdict.name}")
        count_along_x(axes)
        figure.legend(loc="outside lower center", ncols=3, columnspacing=1.0, handletextpad=0.4)
    return figure


def factor_of_M(problem: PGOProblem) -> tuple[csc_array, IntArray]:
    """Cholesky factor L of M with its diagonal doubled, and the order of a solve.

    M itself is singular; the pattern of its factor is the same.
    """
    data = problem.M.data.copy()
    data[problem.diagonal_positions] *= 2.0
    definite = problem.with_pattern_of_M(data)
    return problem.analysis.lower_factor(definite)


def plot_sparsity(problem: PGOProblem) -> Figure:
    """Figure of the patterns of M, in the order of the poses, and of its Cholesky factor.

    The entries of both and the fill-in are counted.
    """
    M = problem.M
    L, _ = factor_of_M(problem)
    fill_in = L.nnz - (M.nnz + problem.side) // 2
    with column_figure(height=0.6) as figure:
        left, right = figure.subplots(1, 2)
        _draw_pattern(left, M)
        _draw_pattern(right, L)
        left.set_title(f"M, {problem.side} x {problem.side}\n{M.nnz:,} entries")
        right.set_title(f"Cholesky factor\n{L.nnz:,} entries")
        share = 100.0 * fill_in / L.nnz
        figure.supxlabel(
            f"fill-in: {fill_in:,} entries, {share:.0f} % of the factor", fontsize=SMALL_POINTS
        )
    return figure


def _draw_pattern(axes: Axes, matrix: csc_array) -> None:
    """Draw the number of stored entries in every cell, on a logarithmic scale.

    While the matrix is small, a cell is an entry.
    """
    side = matrix.shape[0]
    num_cells = min(side, _CELLS)
    entries_of_column = np.diff(matrix.indptr)
    columns = np.repeat(np.arange(side), entries_of_column)
    cell_row = matrix.indices * num_cells // side
    cell_column = columns * num_cells // side
    cell = cell_row * num_cells + cell_column
    counts_of_cells = np.bincount(cell, minlength=num_cells * num_cells)
    counts = counts_of_cells.reshape(num_cells, num_cells)
    shades = np.where(counts > 0, np.log1p(counts), np.nan)
    darkest = float(np.nanmax(shades))
    axes.imshow(
        shades,
        cmap="cividis_r",
        extent=(0, side, side, 0),
        interpolation="nearest",
        vmin=-darkest,  # leaves out the lighter half of the colours, too faint for single cells
    )
    axes.set_xticks([0, side])
    axes.set_yticks([0, side])
