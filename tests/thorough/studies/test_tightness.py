import numpy as np
import pytest

from pgo_models.errors import SettingError
from pgo_models.figures import rounded_up
from pgo_models.plots.curves import plot_tightness
from solvers import SweptScene, noise_sweep
from solvers.studies.tightness import NoiseSweep, noisy_scene

QUIET = np.deg2rad(10.0)
LOUD = np.deg2rad(90.0)


@pytest.mark.parametrize("scene", list(SweptScene))
def test_little_noise_is_certified_and_much_is_not(scene: SweptScene) -> None:
    sweep = noise_sweep(scene, np.array([QUIET, LOUD]), 1, np.random.default_rng(0))
    np.testing.assert_array_equal(sweep.fraction, [1.0, 0.0])
    assert sweep.last_tight == QUIET
    assert (sweep.gap[0] <= 1e-6).all()
    assert (sweep.gap[1] > 1e-6).all()
    worst = rounded_up(sweep.gap[0].max(), 2)
    assert str(sweep).splitlines()[1].split() == ["10.0", "100%", worst, "100%"]
    assert (sweep.certified_with_terms >= sweep.certified).all()
    assert sweep.fraction_with_terms[1] == (1.0 if scene is SweptScene.CIRCLE else 0.0)


def test_the_same_seed_gives_the_same_sweep() -> None:
    first, second = (
        noise_sweep(SweptScene.GRID, np.array([QUIET]), 2, np.random.default_rng(5))
        for _ in range(2)
    )
    np.testing.assert_array_equal(first.gap, second.gap)


def test_the_scene_keeps_all_but_the_rotation_noise() -> None:
    quiet, loud = (
        noisy_scene(SweptScene.CIRCLE, std, np.random.default_rng(1)) for std in (QUIET, LOUD)
    )
    for name in ("i", "j", "t_ij", "kappa", "tau"):
        np.testing.assert_array_equal(getattr(quiet, name), getattr(loud, name))
    assert np.abs(quiet.R_ij - loud.R_ij).max() > 0.1


def test_nothing_certified_has_no_last_level() -> None:
    certified = np.array([[False], [True]])
    sweep = NoiseSweep(SweptScene.GRID, np.array([1.0, 2.0]), certified, np.ones((2, 1)), certified)
    assert np.isnan(sweep.last_tight)


def test_levels_and_graphs_are_checked() -> None:
    rng = np.random.default_rng(0)
    for levels in ([], [0.0], [0.2, 0.1]):
        with pytest.raises(SettingError, match="positive and ascending"):
            noise_sweep(SweptScene.GRID, np.array(levels), 1, rng)
    with pytest.raises(SettingError, match="at least 1"):
        noise_sweep(SweptScene.GRID, np.array([0.1]), 0, rng)


def test_the_picture_has_a_curve_for_every_sweep() -> None:
    pytest.importorskip("matplotlib")
    levels = np.deg2rad([30.0, 60.0])
    figure = plot_tightness(
        [("circle", levels, np.array([1.0, 0.5])), ("grid", levels, np.array([1.0, 0.0]))]
    )
    (axes,) = figure.axes
    assert [line.get_label() for line in axes.lines] == ["circle", "grid"]
    np.testing.assert_allclose(
        axes.lines[0].get_xydata(), [[30.0, 100.0], [60.0, 50.0]], rtol=1e-12, atol=0
    )
    assert "degrees" in axes.get_xlabel()
