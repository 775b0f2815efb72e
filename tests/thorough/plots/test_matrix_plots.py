import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel
from pgo_models.errors import SettingError
from pgo_models.plots.matrix_plots import (
    plot_spectrum,
    smallest_eigenvalues,
)
from pgo_models.problem.matrices import marginalized_matrix


def certificate_of(graph):
    problem = pgo.PGOProblem(graph)
    return problem, solvers.certify(problem, solvers.polish(problem, pgo.chordal_start(problem)))


@pytest.mark.parametrize("num_poses", [6, 120])  # all at once, and by Lanczos
@pytest.mark.parametrize("d", [2, 3])
def test_eigenvalues_are_those_of_the_dense_matrix(num_poses, d):
    graph = pgo.random_geometric(num_poses, np.random.default_rng(num_poses + d), d=d)
    problem, certificate = certificate_of(graph)
    dense = marginalized_matrix(graph)
    for i in range(num_poses):
        block = slice(d * i, d * (i + 1))
        dense[block, block] -= certificate.Lambda[i]
    expected = np.linalg.eigvalsh(dense)
    found = smallest_eigenvalues(problem, certificate.Lambda, 7)
    np.testing.assert_allclose(found, expected[:7], rtol=1e-6, atol=1e-9 * expected[-1])


def test_a_negative_eigenvalue_is_found_with_its_sign():
    graph = pgo.circle(np.random.default_rng(0))
    problem, certificate = certificate_of(graph)
    Lambda = certificate.Lambda + 3.0 * np.eye(3)
    shifted = smallest_eigenvalues(problem, Lambda, 5)
    np.testing.assert_allclose(
        shifted, smallest_eigenvalues(problem, certificate.Lambda, 5) - 3.0, rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("count", [0, 76])
def test_a_count_out_of_range_is_refused(count):
    problem, certificate = certificate_of(pgo.circle(np.random.default_rng(0)))
    with pytest.raises(SettingError, match="75 eigenvalues"):
        smallest_eigenvalues(problem, certificate.Lambda, count)


def test_the_spectrum_is_drawn_by_sign_and_with_the_proofs_eta():
    pytest.importorskip("matplotlib")
    problem, certificate = certificate_of(pgo.circle(np.random.default_rng(0)))
    figure = plot_spectrum(problem, certificate, 9)
    (axes,) = figure.axes
    assert sum(len(line.get_xdata()) for line in axes.lines) == 9
    assert certificate.eta == 0
    assert not any("eta" in label for label in axes.get_legend_handles_labels()[1])


def test_the_spectrum_is_drawn_with_the_shift_of_a_loose_relaxation():
    pytest.importorskip("matplotlib")
    graph = pgo.random_geometric(6, np.random.default_rng(3), noise=NoiseModel(0.5, 1.5))
    problem = pgo.PGOProblem(graph)
    # where the staircase solved the relaxation
    certificate = solvers.solve(problem, solvers.Pipeline(handedness=None)).certificate
    assert certificate.eta > 0
    (axes,) = plot_spectrum(problem, certificate, 9).axes
    assert f"{certificate.eta:.1e}" in axes.get_legend_handles_labels()[1][2]


def test_the_spectrum_of_a_proof_with_terms_is_that_of_the_matrix_less_them():
    pytest.importorskip("matplotlib")
    graph = pgo.random_geometric(6, np.random.default_rng(3), noise=NoiseModel(0.5, 1.5))
    problem = pgo.PGOProblem(graph)
    certificate = solvers.solve(problem).certificate
    assert certificate.bound.terms is not None
    (axes,) = plot_spectrum(problem, certificate, 9).axes
    (_, negative) = (line.get_xdata() for line in axes.lines)
    assert (negative <= 3).all()  # rounding of the three zeros of a common turn
