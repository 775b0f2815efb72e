"""EdgeProblem: what the cost of the edges asks of the problem that it is the cost of."""

from typing import Protocol

from scipy.sparse import csc_array, csr_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.cholesky import SymbolicCholesky
from pgo_models.problem.incidence import Incidence


class EdgeProblem(Protocol):
    """A graph, and what is computed once for it; `PGOProblem` documents each."""

    @property
    def graph(self) -> PoseGraph:
        """The graph whose edges cost something."""

    @property
    def d(self) -> int:
        """Dimension of space."""

    @property
    def num_poses(self) -> int:
        """Number of poses, n."""

    @property
    def residual_matrix(self) -> tuple[csr_array, Array]:
        """A, ((d+1) m, N), and w: the quadratic part is sum_rows w ||A X||^2."""

    @property
    def residual_adjoint(self) -> csc_array:
        """A^T."""

    @property
    def plain_residual_matrix(self) -> csr_array:
        """A with the rotation residuals along the axes of the world."""

    @property
    def incidence(self) -> Incidence:
        """Which edges begin and end at a pose."""

    @property
    def translation_information_analysis(self) -> SymbolicCholesky:
        """Symbolic factorisation of `translation_matrix`."""

    def translation_matrix(self, of_edges: Array) -> csc_array:
        """Laplacian of d x d blocks, of which every edge has one, (m, d, d)."""

    def residuals(self, X: Array) -> Array:
        """A X, ((d+1) m, d), the residuals at X, (N, d)."""

    def recover_translations(self, R: Array) -> Array:
        """The translations of least quadratic part for given rotations, (n, d)."""
