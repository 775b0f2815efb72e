import numpy as np
import pytest
from signals import sparse_signal

from pgo_models.errors import SettingError
from pgo_models.plots.curves import plot_decay
from solvers.studies.forgetting import error_forgetting


def test_errors_of_the_first_steps_are_forgotten_and_the_penalty_alone_keeps_its_own():
    problem, solution = sparse_signal(0)
    runs = error_forgetting(problem, solution, np.random.default_rng(0))
    assert len(runs.undisturbed) == len(runs.disturbed) == len(runs.not_added_back) == 16
    assert runs.disturbed[1:4].min() > 0.1
    assert max(runs.undisturbed[-1], runs.disturbed[-1]) < 1e-4
    assert runs.not_added_back[-1] > 100 * runs.undisturbed[-1]


def test_without_errors_both_runs_are_the_same_bits():
    problem, solution = sparse_signal(1)
    runs = error_forgetting(
        problem, solution, np.random.default_rng(0), error_std=0.0, iterations=4
    )
    np.testing.assert_array_equal(runs.undisturbed, runs.disturbed)


def test_the_figure_has_every_curve_and_a_logarithmic_axis():
    pytest.importorskip("matplotlib")
    problem, solution = sparse_signal(0)
    runs = error_forgetting(problem, solution, np.random.default_rng(0), iterations=5)
    (axes,) = plot_decay(runs.curves(), "distance to the solution").axes
    assert axes.get_yscale() == "log"
    assert [line.get_label() for line in axes.lines] == [label for label, _ in runs.curves()]
    for line, (_, values) in zip(axes.lines, runs.curves(), strict=True):
        np.testing.assert_array_equal(line.get_ydata(), values)


def test_settings_are_checked():
    problem, solution = sparse_signal(0)
    rng = np.random.default_rng(0)
    with pytest.raises(SettingError, match="error_std"):
        error_forgetting(problem, solution, rng, error_std=-1.0)
    with pytest.raises(SettingError, match="disturbed_steps"):
        error_forgetting(problem, solution, rng, disturbed_steps=9, iterations=8)
