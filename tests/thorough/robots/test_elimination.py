from dataclasses import dataclass

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, EPS, LOUD_NOISE, SEEDS, random_poses, varied_problem
from hypothesis import given, settings, strategies as st
from robots import (
    BACKENDS,
    PARTITIONERS,
    Partitioner,
    interface_of,
    leaving,
    matrix_of_schur,
)
from scipy.sparse import csc_array, diags_array

from pgo_models import PGOProblem, Poses
from pgo_models.errors import NotPositiveDefiniteError, SettingError
from pgo_models.geometry.rotations import Array, tangent_dimension
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.hessian import riemannian_hessian
from pgo_models.problem.matrices import columns_of
from solvers.robots.elimination import (
    Cut,
    Elimination,
    FactoredPart,
    eliminate,
)
from solvers.robots.interface import Interface, InterfaceFactor, Separators
from solvers.soc.subgraph import Part, split_graph

SIZES = st.integers(2, 30)
LIMITS = st.sampled_from([None, 0, 3, 1000])  # poses that a robot couples at most
KINDS = st.sampled_from(["translations", "poses", "tangent"])
any_split = given(
    seed=SEEDS,
    n=SIZES,
    d=DIMENSIONS,
    partitioner=PARTITIONERS,
    kind=KINDS,
    backend=BACKENDS,
    most=LIMITS,
)


def widths_of(kind: str, d: int) -> tuple[int, ...]:
    return {"translations": (1,), "poses": (1, d), "tangent": (d, tangent_dimension(d))}[kind]


def matrix_of(problem: PGOProblem, poses: Poses, kind: str) -> csc_array:
    """One of the three matrices that driver and robots work with; positive semidefinite."""
    if kind == "translations":
        return problem.M[: problem.num_poses, : problem.num_poses].tocsc()
    return problem.M.copy() if kind == "poses" else riemannian_hessian(problem.at(poses), None)


@dataclass
class Split:
    """A matrix K + diagonal, whole and as robots and driver hold it."""

    whole: Array
    parts: list[Part]
    pieces: list[csc_array]
    cuts: list[Cut]
    columns: list[IntArray]
    own: list[tuple[IntArray, Array]]
    interface: Interface
    cover_columns: IntArray

    def eliminate(self, backend: CholeskyBackend) -> tuple[list[Elimination], InterfaceFactor]:
        robots = [
            eliminate(piece, cut, backend)
            for piece, cut in zip(self.pieces, self.cuts, strict=True)
        ]
        return robots, self.interface.factorize([robot.schur for robot in robots], self.own)

    def is_positive_definite(self, backend: CholeskyBackend) -> bool:
        try:
            self.eliminate(backend)
        except NotPositiveDefiniteError:
            return False
        return True


def split(
    problem: PGOProblem,
    parts: Partition,
    kind: str,
    seed: int,
    diagonal: Array,
    most_coupled: int | None = None,
) -> Split:
    """Matrix of a kind plus a diagonal, (side,).

    Each robot adds it in its interior, the driver on the cover. With `most_coupled` the robots
    leave poses to the driver.
    """
    n = problem.num_poses
    widths = widths_of(kind, problem.d)
    poses = random_poses(problem.num_poses, problem.d, seed)
    with leaving(np.inf if most_coupled is None else most_coupled):
        shares = [share.for_driver() for share in split_graph(problem.graph, parts)]
    working = [share.part for share in shares if share.part is not None]
    pieces = []
    cuts = []
    columns = []
    for part in working:
        local = Poses(poses.R[part.poses], poses.t[part.poses])
        cut = FactoredPart(part, None).cut(widths)
        mine = columns_of(part.poses, n, widths)
        added = np.zeros(len(mine))
        added[cut.interior] = diagonal[mine[cut.interior]]
        pieces.append((matrix_of(part.problem, local, kind) + diags_array(added)).tocsc())
        cuts.append(cut)
        columns.append(mine)
    separators = Separators.of([share.summary for share in shares])
    cover = separators.cover
    at = columns_of(cover, n, widths)
    return Split(
        whole=matrix_of(problem, poses, kind).toarray() + np.diag(diagonal),
        parts=working,
        pieces=pieces,
        cuts=cuts,
        columns=columns,
        own=[(np.arange(len(at))[:, None], diagonal[at][:, None, None])],
        interface=Interface(separators, widths),
        cover_columns=at,
    )


def side_of(problem: PGOProblem, kind: str) -> int:
    return sum(widths_of(kind, problem.d)) * problem.num_poses


@settings(max_examples=examples(50))
@any_split
def test_elimination_and_back_substitution_solve_the_whole_system(
    seed: int,
    n: int,
    d: int,
    partitioner: Partitioner,
    kind: str,
    backend: CholeskyBackend,
    most: int | None,
) -> None:
    problem = varied_problem(seed, n, d)
    rng = np.random.default_rng(seed)
    scale = float(problem.M.diagonal().max())
    system = split(
        problem,
        partitioner(problem.graph, seed),
        kind,
        seed,
        scale * rng.uniform(1e-3, 1.0, side_of(problem, kind)),
        most,
    )
    robots, driver = system.eliminate(backend)
    b = rng.standard_normal((len(system.whole), 3))
    # every part of b is somebody's: of the robot inside, of the first who touches it on the cover
    shares = []
    left = b.copy()
    for mine in system.columns:
        shares.append(left[mine])
        left[mine] = 0.0
    reduced = [robot.reduce(share) for robot, share in zip(robots, shares, strict=True)]
    x_G, on_parts, of_cover = driver.solve([vector for vector, _ in reduced])
    x = np.full_like(b, np.nan)
    for one, other in zip(on_parts, system.interface.scatter(x_G), strict=True):
        np.testing.assert_array_equal(one, other)
    for mine, robot, share, part in zip(system.columns, robots, shares, on_parts, strict=True):
        x[mine] = robot.back_substitute(share, part)
    np.testing.assert_array_equal(x[system.cover_columns], x_G)
    allowed = 100 * EPS * len(b) * np.linalg.norm(system.whole, 2) * np.linalg.norm(x)
    assert np.linalg.norm(system.whole @ x - b) <= allowed
    energy = sum(inside for _, inside in reduced) + of_cover
    assert energy == pytest.approx(np.vdot(b, x), rel=1e-9)


@settings(max_examples=examples(50))
@any_split
def test_robots_hold_the_matrix_between_them(
    seed: int,
    n: int,
    d: int,
    partitioner: Partitioner,
    kind: str,
    backend: CholeskyBackend,
    most: int | None,
) -> None:
    problem = varied_problem(seed, n, d)
    system = split(
        problem, partitioner(problem.graph, seed), kind, seed, np.ones(side_of(problem, kind)), most
    )
    total = np.zeros_like(system.whole)
    for mine, piece in zip(system.columns, system.pieces, strict=True):
        total[np.ix_(mine, mine)] += piece.toarray()
    total[system.cover_columns, system.cover_columns] += 1.0
    scale = np.abs(system.whole).max()
    np.testing.assert_allclose(total, system.whole, rtol=0, atol=100 * EPS * scale)
    for robot, piece, cut in zip(
        system.eliminate(backend)[0], system.pieces, system.cuts, strict=True
    ):
        K = piece.toarray()
        inside = cut.interior
        g = cut.boundary
        expected = K[np.ix_(g, g)]
        if len(inside):
            expected = expected - K[np.ix_(g, inside)] @ np.linalg.solve(
                K[np.ix_(inside, inside)], K[np.ix_(inside, g)]
            )
        np.testing.assert_allclose(matrix_of_schur(robot), expected, rtol=0, atol=1e-9 * scale)
        np.testing.assert_array_equal(robot.diagonal, K.diagonal()[g])


@settings(max_examples=examples(50))
@any_split
def test_the_whole_is_positive_definite_where_all_parts_of_it_are(
    seed: int,
    n: int,
    d: int,
    partitioner: Partitioner,
    kind: str,
    backend: CholeskyBackend,
    most: int | None,
) -> None:
    # Inertia is additive: just above and just below its smallest eigenvalue the verdict is that of
    # the whole.
    problem = varied_problem(seed, n, d, LOUD_NOISE)
    parts = partitioner(problem.graph, seed)
    side = side_of(problem, kind)
    rng = np.random.default_rng(seed)
    rough = float(problem.M.diagonal().max()) * rng.standard_normal(side)
    whole = split(problem, parts, kind, seed, rough, most).whole
    values = np.linalg.eigvalsh(whole)
    near = 1e-9 * np.abs(values).max()
    for sign, expected in ((1.0, True), (-1.0, False)):
        shifted = split(problem, parts, kind, seed, rough - values[0] + sign * near, most)
        assert shifted.is_positive_definite(backend) is expected


def test_numbers_that_are_not_finite_are_not_positive_definite() -> None:
    touched = (np.array([0, 1]),)
    interface = interface_of(touched, 2, (1,))
    for bad in (np.nan, np.inf):
        with pytest.raises(NotPositiveDefiniteError, match="nan or inf"):
            interface.factorize([np.array([1.0, bad, 1.0])])


def test_without_separators_there_is_nothing_to_solve() -> None:
    interface = interface_of((np.zeros(0, dtype=int),), 0, (1, 3))
    factor = interface.factorize([np.zeros(0)])
    assert factor.solve([np.zeros((0, 3))])[0].shape == (0, 3)


# The driver's memory.


def copies(seed: int, number: int, separators: int, each: int) -> tuple[IntArray, ...]:
    """Robots that each touch some separators: half of them along a ring, half anywhere."""
    rng = np.random.default_rng(seed)
    touched = []
    for robot in range(number):
        near = (robot * separators // number + np.arange(each // 2)) % separators
        touched.append(np.union1d(near, rng.choice(separators, each - each // 2, replace=False)))
    return tuple(touched)


def test_what_would_not_fit_is_refused_with_the_way_out() -> None:
    touched = copies(0, 5, 160, 70)
    interface = interface_of(touched, 160, (3, 3))
    interface.check_memory(interface.num_bytes)
    too_large = r"for 160 separators, more than .* METIS partition or fewer robots, "
    with pytest.raises(SettingError, match=too_large + "raise driver_memory"):
        interface.check_memory(interface.num_bytes - 1)
