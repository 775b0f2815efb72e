"""Figure of the spectrum of the certificate matrix S near zero."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse.linalg import eigsh

from pgo_models.certificates.certificate import Certificate
from pgo_models.certificates.spectrum import rotation_inverse, smallest_definite_shift
from pgo_models.errors import SettingError
from pgo_models.figures import rounded_up
from pgo_models.geometry.rotations import Array
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, QUIET_COLOUR, column_figure, count_along_x
from pgo_models.problem.problem import PGOProblem

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FIRST_SHIFT = 1e-6  # as a share of the mean diagonal entry of M
_DENSE_SIDE = 200  # up to this side of S all eigenvalues are computed by a dense method


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
