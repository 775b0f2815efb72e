"""Factors of the matrices of a robot's interior.

A state holds the matrix alone, from which its factors can be computed again.
"""

from dataclasses import dataclass

from scipy.sparse import csc_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.matrices import columns_of
from solvers.distributed.robots.elimination import Cut, Elimination, eliminate
from solvers.distributed.robots.subdomain_blocks import SubdomainBlocks, Widths
from solvers.soc.subgraph import Part


@dataclass(frozen=True, eq=False)
class Eliminated:
    """The matrix that was eliminated last, as arrays, and its unknowns per pose."""

    data: Array
    indices: IntArray
    indptr: IntArray
    widths: Widths

    @property
    def matrix(self) -> csc_array:
        """The matrix."""
        return csc_array((self.data, self.indices, self.indptr))


class Factors:
    """Factors of the matrices in a robot's state.

    They are computed again where the state that asks holds another matrix than the one that was
    factored last.
    """

    def __init__(self, part: Part, backend: CholeskyBackend | None) -> None:
        self.part = part
        self.backend = backend
        self._cuts: dict[Widths, Cut] = {}
        self._last: tuple[Eliminated, Elimination] | None = None
        self._laplacian: Elimination | None = None

    @property
    def grounds(self) -> bool:
        """Whether pose 0 is in the interior; else another robot or the driver grounds it."""
        has_pose_0 = bool(self.part.poses[0] == 0)
        is_interior = bool(self.part.in_cover[0] < 0)
        return has_pose_0 and is_interior

    def cut(self, *widths: int) -> Cut:
        """Cut of unknowns with these numbers per pose into interior and boundary."""
        if widths not in self._cuts:
            part = self.part
            p = part.problem.num_poses
            interior = columns_of(part.interior, p, widths)
            boundary = columns_of(part.boundary, p, widths)
            blocks = None
            if part.is_sparse:
                blocks = SubdomainBlocks.of(part.subdomains, widths)
            self._cuts[widths] = Cut(interior, boundary, None, blocks)
        return self._cuts[widths]

    def eliminate(self, K: csc_array, widths: Widths) -> tuple[Eliminated, Elimination]:
        """Eliminate the interior of K x = b."""
        self._last = None  # its memory may be needed
        elimination = eliminate(K, self.cut(*widths), self.backend)
        return self.keep(K, widths, elimination), elimination

    def keep(self, K: csc_array, widths: Widths, elimination: Elimination) -> Eliminated:
        """Remember an elimination of K; its analysis is the same the next time."""
        eliminated = Eliminated(K.data, K.indices, K.indptr, widths)
        self._cuts[widths] = elimination.cut
        self._last = (eliminated, elimination)
        return eliminated

    def of(self, eliminated: Eliminated | None) -> Elimination:
        """Elimination of the matrix in a state, computed again if it is not the last one."""
        assert eliminated is not None
        if self._last is None or self._last[0] is not eliminated:
            cut = self.cut(*eliminated.widths)
            elimination = eliminate(eliminated.matrix, cut, self.backend)
            self._last = (eliminated, elimination)
        return self._last[1]

    @property
    def laplacian(self) -> Elimination:
        """Elimination of the matrix of the translations."""
        if self._laplacian is None:
            problem = self.part.problem
            p = problem.num_poses
            M_tt = problem.M[:p, :p].tocsc()
            if self.grounds:
                M_tt[0, 0] *= 2.0
            self._laplacian = eliminate(M_tt, self.cut(1), self.backend)
        return self._laplacian
