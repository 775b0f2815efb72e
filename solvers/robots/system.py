"""A robot's part of the graph with its factors, and a system whose interior is eliminated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from scipy.sparse import csc_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.matrices import columns_of
from solvers.carry.registry import record
from solvers.carry.serialization import COMPUTED_AGAIN
from solvers.robots.elimination import Cut, Elimination, eliminate
from solvers.robots.records import Reduced, RightHandSide
from solvers.robots.subdomain_blocks import SubdomainBlocks, Widths
from solvers.soc.subgraph import Part


@record("System")
@dataclass(frozen=True, eq=False)
class System:
    """A robot's system K x = b, with the interior eliminated to the boundary.

    A snapshot has the matrix alone, of which `FactoredPart.eliminated_again` makes the elimination.
    """

    # of K, of side `side`, by columns
    data: Array
    indices: IntArray
    indptr: IntArray
    widths: Widths  # unknowns per pose, field by field
    b: Array  # (side, k)
    known_elimination: Elimination | None = field(default=None, metadata=COMPUTED_AGAIN)

    @classmethod
    def of(cls, K: csc_array, widths: Widths, b: Array, elimination: Elimination) -> System:
        """The system of a matrix and its elimination."""
        return cls(K.data, K.indices, K.indptr, widths, b, elimination)

    @property
    def elimination(self) -> Elimination:
        """The matrix with the interior eliminated."""
        assert self.known_elimination is not None
        return self.known_elimination

    @property
    def right(self) -> RightHandSide:
        """Right-hand side on the boundary, and b_I . K_II^-1 b_I."""
        return RightHandSide(*self.elimination.reduce(self.b))

    def with_right(self, b: Array) -> tuple[System, RightHandSide]:
        """The system with the right-hand side b, and b reduced to the boundary."""
        following = replace(self, b=b)
        return following, following.right

    def reduced(self, right: RightHandSide) -> Reduced:
        """What the driver needs of the system, with its `right`."""
        return Reduced(self.elimination.schur, self.elimination.diagonal, right)

    def back_substitute(self, x: Array) -> Array:
        """Solution, (side, k), from its rows on the boundary."""
        return self.elimination.back_substitute(self.b, x)


@dataclass(frozen=True, eq=False)
class FactoredPart:
    """A robot's part of the graph, and what is known of its factors whatever the poses are.

    `cuts` are where unknowns are cut into interior and boundary, with the analyses of the matrices
    that were eliminated there. The translations have one matrix, M_tt, whose elimination is known
    once it was needed.
    """

    part: Part
    backend: CholeskyBackend | None
    cuts: Mapping[Widths, Cut] = field(default_factory=dict)
    known_laplacian: Elimination | None = None

    @classmethod
    def of(cls, part: Part, backend: CholeskyBackend | None) -> FactoredPart:
        """A part with the cut of the rows of X, which every algorithm needs."""
        plain = cls(part, backend)
        of_X = (1, part.problem.d)
        return replace(plain, cuts={of_X: plain.cut(of_X)})

    @property
    def grounds(self) -> bool:
        """Whether pose 0 is in the interior; else another robot or the driver grounds it."""
        has_pose_0 = bool(self.part.poses[0] == 0)
        is_interior = bool(not self.part.is_separator[0])
        return has_pose_0 and is_interior

    def cut(self, widths: Widths) -> Cut:
        """Cut of unknowns with these numbers per pose into interior and boundary."""
        if widths in self.cuts:
            return self.cuts[widths]
        part = self.part
        p = part.problem.num_poses
        interior = columns_of(part.interior, p, widths)
        boundary = columns_of(part.boundary, p, widths)
        return Cut(interior, boundary, SubdomainBlocks(part.subdomains, widths))

    def eliminate(self, K: csc_array, widths: Widths) -> tuple[FactoredPart, Elimination]:
        """Eliminate the interior of a matrix, with the analysis of the last one like it."""
        elimination = eliminate(K, self.cut(widths), self.backend)
        return self.with_cut(widths, elimination.cut), elimination

    def with_cut(self, widths: Widths, cut: Cut) -> FactoredPart:
        """The part with a cut whose analysis is known."""
        return replace(self, cuts={**self.cuts, widths: cut})

    def eliminated_again(self, system: System) -> System:
        """The system of a snapshot with its elimination."""
        K = csc_array((system.data, system.indices, system.indptr))
        return replace(
            system, known_elimination=eliminate(K, self.cut(system.widths), self.backend)
        )

    def with_laplacian(self) -> FactoredPart:
        """The part with the elimination of the matrix of the translations."""
        if self.known_laplacian is not None:
            return self
        problem = self.part.problem
        p = problem.num_poses
        M_tt = problem.M[:p, :p].tocsc()
        if self.grounds:
            # As in `Driver.grounding_block`: M_tt alone is singular, a shift of all costs nothing.
            M_tt[0, 0] *= 2.0
        following, elimination = self.eliminate(M_tt, (1,))
        return replace(following, known_laplacian=elimination)

    @property
    def laplacian(self) -> Elimination:
        """Elimination of the matrix of the translations, of `with_laplacian`."""
        assert self.known_laplacian is not None
        return self.known_laplacian

    def with_weights_of(self, part: Part) -> FactoredPart:
        """The factors of a part with other weights, whose matrices have the same patterns."""
        return replace(self, part=part, known_laplacian=None)
