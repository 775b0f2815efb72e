"""Factors of the matrices of a robot's interior; what a state holds is the matrix, so that they can be found again."""

from dataclasses import dataclass

from scipy.sparse import csc_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.matrices import columns_of
from solvers.distributed.robots.elimination import Cut, Elimination, Widths, eliminate
from solvers.soc.subgraph import Part


@dataclass(frozen=True, eq=False)
class Eliminated:
    """The matrix that was eliminated last, as arrays, and its unknowns a pose."""

    data: Array
    indices: IntArray
    indptr: IntArray
    widths: Widths

    @property
    def matrix(self) -> csc_array:
        """The matrix."""
        return csc_array((self.data, self.indices, self.indptr))


class Factors:
    """Factors of what is in a state: they are found again when they are not those of the state that asks."""

    def __init__(self, part: Part, backend: CholeskyBackend | None) -> None:
        self.part, self.backend = part, backend
        self._cuts: dict[Widths, Cut] = {}
        self._of: tuple[Eliminated, Elimination] | None = None
        self._laplacian: Elimination | None = None

    @property
    def grounds(self) -> bool:
        """Whether pose 0 is in the interior; else another robot or the driver holds it down."""
        return bool(self.part.poses[0] == 0) and bool(self.part.in_cover[0] < 0)

    def cut(self, *widths: int) -> Cut:
        """Where unknowns with so many numbers a pose are cut."""
        if widths not in self._cuts:
            part, p = self.part, self.part.problem.num_poses
            own, boundary = columns_of(part.interior, p, widths), columns_of(part.boundary, p, widths)
            self._cuts[widths] = Cut(own, boundary, None)
        return self._cuts[widths]

    def eliminate(self, K: csc_array, widths: Widths) -> tuple[Eliminated, Elimination]:
        """Eliminate the interior of K x = b."""
        self._of = None  # its memory may be needed
        found = eliminate(K, self.cut(*widths), self.backend)
        return self.keep(K, widths, found), found

    def keep(self, K: csc_array, widths: Widths, found: Elimination) -> Eliminated:
        """Remember an elimination of K; its analysis is the same the next time."""
        eliminated = Eliminated(K.data, K.indices, K.indptr, widths)
        self._cuts[widths], self._of = found.cut, (eliminated, found)
        return eliminated

    def of(self, eliminated: Eliminated | None) -> Elimination:
        """Elimination of a matrix that was eliminated."""
        assert eliminated is not None
        if self._of is None or self._of[0] is not eliminated:
            self._of = eliminated, eliminate(eliminated.matrix, self.cut(*eliminated.widths), self.backend)
        return self._of[1]

    @property
    def laplacian(self) -> Elimination:
        """Elimination of the matrix of the translations."""
        if self._laplacian is None:
            problem = self.part.problem
            M_tt = problem.M[: problem.num_poses, : problem.num_poses].tocsc()
            if self.grounds:
                M_tt[0, 0] *= 2.0
            self._laplacian = eliminate(M_tt, self.cut(1), self.backend)
        return self._laplacian
