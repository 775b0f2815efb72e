import numpy as np
import pytest
from hypothesis import given, strategies as st

from pgo_models import PoseGraph, grid_world
from pgo_models.errors import SettingError
from pgo_models.graphs.scenes import MILD_NOISE

SEEDS = st.integers(0, 2**32 - 1)
DIMENSIONS = st.sampled_from([2, 3])
ROBOTS = st.integers(1, 8)
POSES = st.integers(2, 30)
PROBABILITY = st.sampled_from([0.0, 0.1, 1.0])


def consecutive(graph: PoseGraph) -> np.ndarray:
    return (graph.j == graph.i + 1) & (graph.robots[graph.i] == graph.robots[graph.j])


@given(seed=SEEDS, num_robots=ROBOTS, poses=POSES, d=DIMENSIONS, probability=PROBABILITY)
def test_a_world_is_connected_and_walked(
    seed: int, num_robots: int, poses: int, d: int, probability: float
) -> None:
    graph = grid_world(
        num_robots, poses, np.random.default_rng(seed), d=d, loop_closure_probability=probability
    )
    assert graph.is_connected
    assert (graph.num_poses, graph.num_robots, graph.d) == (num_robots * poses, num_robots, d)
    np.testing.assert_array_equal(graph.robots, np.repeat(np.arange(num_robots), poses))
    assert (graph.i < graph.j).all()
    assert len(set(zip(graph.i.tolist(), graph.j.tolist(), strict=True))) == graph.num_edges
    assert (graph.kappa == MILD_NOISE.kappa(d)).all()
    assert (graph.tau == MILD_NOISE.tau).all()
    truth = graph.truth
    assert truth is not None
    np.testing.assert_array_equal(truth.t, np.rint(truth.t))
    np.testing.assert_array_equal(np.abs(truth.R), np.rint(np.abs(truth.R)))
    assert truth.t.min() >= 0
    # Odometry: one cell ahead along the x axis of the later pose, which is turned by 0 or 90
    # degrees.
    odometry = consecutive(graph)
    assert odometry.sum() == num_robots * (poses - 1)
    i = graph.i[odometry]
    j = graph.j[odometry]
    np.testing.assert_array_equal(truth.t[j] - truth.t[i], truth.R[j][:, :, 0])
    assert (np.einsum("ma,ma->m", truth.R[i][:, :, 0], truth.R[j][:, :, 0]) >= 0).all()


@pytest.mark.parametrize("d", [2, 3])
def test_loop_closures_come_with_their_probability(d: int) -> None:
    def count(probability: float) -> int:
        graph = grid_world(
            10, 200, np.random.default_rng(0), d=d, loop_closure_probability=probability
        )
        return int((~consecutive(graph)).sum())

    all_of_them = count(1.0)
    five_sigma = 5 * np.sqrt(all_of_them * 0.3 * 0.7)
    assert abs(count(0.3) - 0.3 * all_of_them) < five_sigma


def test_robots_see_themselves_and_each_other() -> None:
    graph = grid_world(10, 200, np.random.default_rng(0))
    closures = ~consecutive(graph)
    same = graph.robots[graph.i] == graph.robots[graph.j]
    assert (closures & same).any()
    assert (closures & ~same).any()


def test_the_same_seed_gives_the_same_bits() -> None:
    a, b = (grid_world(3, 20, np.random.default_rng(5), d=2) for _ in range(2))
    np.testing.assert_array_equal(a.R_ij, b.R_ij)
    np.testing.assert_array_equal(a.t_ij, b.t_ij)


@pytest.mark.parametrize(
    ("num_robots", "poses", "d", "probability", "message"),
    [
        (0, 5, 3, 0.1, "num_robots must be at least 1, got 0"),
        (2, 1, 3, 0.1, "poses_per_robot must be at least 2, got 1"),
        (2, 5, 1, 0.1, "d must be 2 or 3, got 1"),
        (2, 5, 3, 1.5, "between 0 and 1, got 1.5"),
        (2, 5, 3, np.nan, "between 0 and 1, got nan"),
    ],
)
def test_settings_are_checked(
    num_robots: int, poses: int, d: int, probability: float, message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        grid_world(
            num_robots, poses, np.random.default_rng(0), d=d, loop_closure_probability=probability
        )
