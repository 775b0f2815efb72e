"""The errors of weights that are computed in doubles hold in exact arithmetic, and are small."""

from __future__ import annotations

import pickle
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from drawn_graphs import covariances, drawn_file, robot_log, spread_matrices
from flint import fmpq, fmpq_mat
from graphs import SEEDS
from hypothesis import given, strategies as st

import solvers
from pgo_models import PGOProblem, Weighting, certify_at, load, read_g2o, write_g2o
from pgo_models.errors import FileFormatError
from pgo_models.figures import scaled_above, scaled_below
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.g2o_tags import TAGS, Noise, Tag
from pgo_models.graphs.precisions import edge_precisions
from pgo_models.graphs.weight_errors import MOST, entry_error, inverse_error
from pgo_models.verification.balls import exact, is_semidefinite

pytestmark = pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")


def exact_matrix(A: Array) -> fmpq_mat:
    return fmpq_mat([[exact(float(x)) for x in row] for row in A])


def is_between(W: Array, of_file: fmpq_mat, error: float) -> bool:
    """Whether (1 - error) W <= of_file <= (1 + error) W, exactly."""
    stored = exact_matrix(W)
    share = exact(error)
    below = of_file - (1 - share) * stored
    above = (1 + share) * stored - of_file
    return is_semidefinite(below.tolist()) and is_semidefinite(above.tolist())


def rows_of(kind: Tag, numbers: Array) -> Array:
    """Information matrices that a tag makes of lines."""
    triangles = kind._with_information(numbers)[:, kind.num_measured :]
    k = kind._side
    matrices = np.zeros((len(numbers), k, k))
    upper = np.triu_indices(k)
    matrices[:, upper[0], upper[1]] = triangles
    matrices[:, upper[1], upper[0]] = triangles
    return matrices


@given(SEEDS, st.sampled_from(["ODOMETRY", "LANDMARK"]), st.floats(0.0, 12.0))
def test_inverted_covariances_are_within_their_errors(seed: int, tag: str, decades: float) -> None:
    rng = np.random.default_rng(seed)
    kind = TAGS[tag]
    C = spread_matrices(rng, 4, kind._side, decades)
    # Units of their own do not matter.
    units = 10.0 ** rng.uniform(-6.0, 6.0, kind._side)
    C = C * units[:, None] * units
    numbers = np.hstack(
        [rng.standard_normal((4, kind.num_measured)), C[:, *np.triu_indices(kind._side)]]
    )
    errors = kind.weights_error(numbers)
    information = rows_of(kind, numbers)
    for C_e, W, error in zip(C, information, errors.tolist(), strict=True):
        if error > MOST:
            assert decades > 10.0
            continue
        condition = 10.0**decades
        assert error < 1e-14 * (10.0 + 100.0 * condition)
        upper = np.triu(C_e) + np.triu(C_e, 1).T
        of_file = exact_matrix(upper).inv()
        assert is_between(W, of_file, error)
        # Half a unit of the last digit of every decimal number.
        shaken = exact_matrix(upper)
        for a in range(kind._side):
            for b in range(a, kind._side):
                sign = int(rng.choice([-1, 1]))
                shaken[a, b] = shaken[b, a] = shaken[a, b] * (1 + fmpq(sign, 2**53))
        assert is_between(W, shaken.inv(), error)


@given(SEEDS, st.floats(0.0, 8.0))
def test_precisions_of_inverted_covariances_are_within_their_errors(
    seed: int, decades: float
) -> None:
    rng = np.random.default_rng(seed)
    C = spread_matrices(rng, 4, 6, decades)
    kind = Tag(3, 2, noise=Noise.COVARIANCE)
    numbers = np.hstack([np.zeros((4, 7)), C[:, *np.triu_indices(6)]])
    errors = kind.weights_error(numbers)
    kappa, tau = edge_precisions(rows_of(kind, numbers))
    for e, error in enumerate(errors.tolist()):
        of_file = exact_matrix(np.triu(C[e]) + np.triu(C[e], 1).T).inv()
        blocks = [
            fmpq_mat([[of_file[a, b] for b in part] for a in part]).inv()
            for part in (range(3), range(3, 6))
        ]
        traces = [sum((block[a, a] for a in range(3)), fmpq(0)) for block in blocks]
        expected = [3 / traces[0], fmpq(3, 2) / traces[1]]
        for found, value in zip((tau[e], kappa[e]), expected, strict=True):
            assert abs(value - exact(float(found))) <= exact(error) * exact(float(found))


@given(SEEDS, st.floats(0.0, 5.0))
def test_squared_square_roots_are_within_their_errors(seed: int, decades: float) -> None:
    rng = np.random.default_rng(seed)
    kind = Tag(2, 2, noise=Noise.SQUARE_ROOT)
    U = np.linalg.cholesky(spread_matrices(rng, 4, 3, decades)).mT
    numbers = np.hstack([np.zeros((4, 3)), U[:, *np.triu_indices(3)]])
    errors = kind.weights_error(numbers)
    for U_e, W, error in zip(U, rows_of(kind, numbers), errors.tolist(), strict=True):
        root = exact_matrix(np.triu(U_e))
        assert is_between(W, root.transpose() * root, error)
        assert error < 1e-12 * 10.0**decades


def rational_rotation(quaternion: Array) -> fmpq_mat:
    """Rotation of a quaternion x y z w of any length, exactly."""
    x, y, z, w = (exact(float(number)) for number in quaternion)
    twice = 2 / (x * x + y * y + z * z + w * w)
    rows = [
        [1 - twice * (y * y + z * z), twice * (x * y - z * w), twice * (x * z + y * w)],
        [twice * (x * y + z * w), 1 - twice * (x * x + z * z), twice * (y * z - x * w)],
        [twice * (x * z - y * w), twice * (y * z + x * w), 1 - twice * (x * x + y * y)],
    ]
    return fmpq_mat(rows)


@given(SEEDS, st.floats(0.0, 5.0))
def test_matrices_of_sensors_beside_their_poses_are_within_their_errors(
    tmp_path_factory: pytest.TempPathFactory, seed: int, decades: float
) -> None:
    rng = np.random.default_rng(seed)
    q = rng.standard_normal(4)
    t = 10.0 * rng.standard_normal(3)
    information = spread_matrices(rng, 1, 6, decades)[0]
    triangle = information[np.triu_indices(6)]
    path = tmp_path_factory.mktemp("offset") / "graph.g2o"
    path.write_text(
        f"PARAMS_SE3OFFSET 1 {' '.join(map(repr, [*t.tolist(), *q.tolist()]))}\n"
        f"EDGE_SE3_OFFSET 0 1 0 1 1 2 3 0 0 0 1 {' '.join(map(repr, triangle.tolist()))}\n"
    )
    graph = read_g2o(path)
    assert graph.information is not None
    R_T = rational_rotation(q).transpose()
    x, y, z = (exact(float(number)) for number in t)
    cross = fmpq_mat([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    of_turn = -1 * (R_T * cross)
    top = [[R_T[a, b] for b in range(3)] + [of_turn[a, b] for b in range(3)] for a in range(3)]
    bottom = [[fmpq(0)] * 3 + [R_T[a, b] for b in range(3)] for a in range(3)]
    A = fmpq_mat(top + bottom)
    of_file = A.transpose() * exact_matrix(np.triu(information) + np.triu(information, 1).T) * A
    assert is_between(graph.information[0], of_file, graph.weights_error)
    # The turned matrix grows with the square of the lever, and its smallest eigenvalue falls so.
    lever = 1.0 + float(t @ t)
    # The error is of use as long as it is far below the gaps that are asked for.
    assert 0.0 < graph.weights_error < 1e-12 * lever**2 * 10.0**decades


def test_bearings_have_small_errors_and_information_none() -> None:
    polar = np.array([[0.3, 5.0, 0.01, 0.1], [3.0, 1.0, 0.1, 0.1]])
    assert (TAGS["BR"].weights_error(polar) < 1e-11).all()
    assert (TAGS["BR"].weights_error(polar) > 0.0).all()
    assert not TAGS["EDGE_SE2"].weights_error(np.ones((2, 9))).any()


def test_nothing_is_claimed_of_matrices_that_are_singular_to_rounding() -> None:
    A = np.array([[[1.0, 1.0], [1.0, 1.0 + 2.0**-52]]])
    assert inverse_error(A, np.linalg.inv(A)) == np.inf
    assert inverse_error(-np.eye(2)[None] + 2.0 * np.eye(2), -np.eye(2)[None]) == np.inf
    assert entry_error(np.ones((1, 2, 2)), 1e-20 * np.ones((1, 2, 2))) == np.inf


def test_a_covariance_that_doubles_cannot_invert_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    good = "ODOMETRY 0 1 1 0 0 1 0 0 1 0 1\n"
    path.write_text(f"{good}ODOMETRY 1 2 1 0 0 1 0.99999999999999 0 1 0 1\n")
    with pytest.raises(FileFormatError, match="doubles cannot hold the information") as error:
        read_g2o(path)
    assert error.value.line == 2


def test_the_error_stays_with_the_graph_and_goes_with_other_weights(tmp_path: Path) -> None:
    path = drawn_file(covariances, 1, tmp_path)
    graph = read_g2o(path)
    error = graph.weights_error
    assert error > 0.0
    assert pickle.loads(pickle.dumps(graph)).weights_error == error
    assert graph.edge_subgraph(np.array([0])).weights_error == error
    assert graph.without_edges(np.arange(graph.num_edges) == 0).weights_error == error
    assert graph.unit_weights().weights_error == 0.0
    write_g2o(graph, tmp_path / "information.g2o")
    assert read_g2o(tmp_path / "information.g2o").weights_error == 0.0


@pytest.mark.parametrize("draw", [covariances, robot_log])
def test_certificates_count_it_everywhere(draw: object, tmp_path: Path) -> None:
    path = drawn_file(draw, 1, tmp_path)  # type: ignore[arg-type]
    problem = PGOProblem(load(path), weighting=Weighting.ISOTROPIC)
    error = problem.graph.weights_error
    assert error > 0.0
    alone = solvers.solve(problem)
    for certificate in (
        alone.certificate,
        solvers.solve(problem, robots=2).certificate,
        certify_at(problem, alone.poses),
    ):
        assert certificate.weights_error == error
        assert certificate.lower_bound == scaled_below(certificate.bound.value, error)
        assert certificate.lower_bound < certificate.bound.value
        assert certificate.objective_at_most >= scaled_above(certificate.objective, error)
        assert certificate.gap >= 2.0 * error * (1.0 - 2.0 * error)


def test_scaled_doubles_are_on_the_right_side() -> None:
    rng = np.random.default_rng(0)
    for value, error in zip(
        rng.uniform(0.0, 1e9, 200), 10.0 ** rng.uniform(-17, -2, 200), strict=True
    ):
        low = scaled_below(float(value), float(error))
        high = scaled_above(float(value), float(error))
        assert Fraction(low) <= (1 - Fraction(error)) * Fraction(value)
        assert Fraction(high) >= (1 + Fraction(error)) * Fraction(value)
