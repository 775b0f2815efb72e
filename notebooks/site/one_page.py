"""The method on one page, A4, for a lecture: formulas and two pictures, drawn by matplotlib.

    python notebooks/site/one_page.py method.pdf

The build of the site makes it, too. The curves are those of a run: costs and proven bounds of the
iterates of SOC on the data set `sphere`.
"""

import itertools
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

ROOT = Path(__file__).parent.parent.parent
sys.path.insert(0, str(ROOT))

import pgo_models as pgo  # noqa: E402 - on the path that is set above
import solvers  # noqa: E402
from pgo_models.plots.graph_plots import draw_graph  # noqa: E402
from pgo_models.plots.style import COLOURS  # noqa: E402

if TYPE_CHECKING:
    from matplotlib.figure import Figure

A4 = (8.27, 11.69)  # inches
NUM_ITERATES = 20
LEFT = 0.09  # of the width
# The page from its top to its foot: headings, formulas (indented) and lines of text.
TEXT = r"""
# Pose graph optimisation by splitting, with a proof
Edges measure the pose of j seen from i, with precisions kappa and tau. Least squares is convex,
    $\min_{R,\,t}\ F = \sum_{(i,j)} \kappa_{ij} \Vert R_j - R_i R_{ij} \Vert_F^2
    + \tau_{ij} \Vert t_j - t_i - R_i t_{ij} \Vert^2,\quad R_i \in \mathrm{SO}(d),$
but for the constraint that the R are rotations.
# Splitting of orthogonality constraints (SOC)
Every rotation gets a copy omega, which carries the constraint. With a penalty rho, repeat
    $(a)\quad R,\, t \,=\, \mathrm{argmin}\ F(R, t) + \frac{\rho}{2} \Vert R - \omega + B \Vert_F^2$
    $(b)\quad \omega_i \,=\, U\, \mathrm{diag}(1, .., 1, \det U V^T)\, V^T,
    \quad R_i + B_i = U D V^T$
    $(c)\quad B \,\leftarrow\, B + R - \omega$
(a) is one sparse linear system, factored once, and (b) an SVD for each pose. Adding the residual
back in (c) is Bregman iteration, which makes the penalty exact. With one pass of (a) and (b) before
each (c) this is ADMM in scaled form, and rho B is its multiplier. Robots agree on one omega.
# The certificate
$X$ has all $t_i^T$ and $R_i^T$, and $F = \mathrm{tr}\, X^T M X$. Multipliers of $R_i R_i^T = I$ are
    $\Lambda_i = \mathrm{sym}\,(M X)_i R_i,\qquad S = M - \mathrm{blockdiag}(0, \Lambda),$
and $S X = 0$ at an optimum. For all poses $Y$ we have
    $F(Y) \,=\, \mathrm{tr}\, Y^T S Y + \sum_i\, \mathrm{tr}\, \Lambda_i,$
so that no poses cost less if $S$ is positive semidefinite. At any other poses, with $G = S X$,
and $r$ for all rows but those of one pose, one sparse factorisation proves
    $F(Y) \,\geq\, F(X) - \mathrm{tr}\, G_r^T S_r^{-1} G_r \quad \mathrm{if\ } S_r \succ 0.$
The gap (F - bound) / F is the largest share of the cost that any other poses could save.
"""


def one_page() -> "Figure":
    """Return the page as a figure of matplotlib."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=A4)
    height = 0.955
    for line in re.sub(r"\n +(?=[^$ ])", " ", TEXT.strip()).splitlines():
        if line.startswith("# "):
            height -= 0.012
            figure.text(LEFT, height, line[2:], fontsize=14, weight="bold", color=COLOURS[0])
            height -= 0.027
        elif line.startswith(" "):
            figure.text(LEFT + 0.04, height - 0.008, line.strip(), fontsize=11.5)
            height -= 0.036
        else:
            figure.text(LEFT, height, line, fontsize=9.7)
            height -= 0.022
    _draw_run(figure, height)
    return figure


def _draw_run(figure: "Figure", top: float) -> None:
    """Draw a run of SOC below a height: costs and bounds of its iterates, and the solved graph."""
    problem = pgo.PGOProblem(pgo.load("sphere"))
    soc = solvers.SOC()
    states = itertools.islice(solvers.iterate(soc, problem), NUM_ITERATES)
    certificates = [pgo.certify_at(problem, soc.poses(problem, state)) for state in states]
    best = solvers.solve(problem)
    above = np.array([item.objective for item in certificates]) / best.objective - 1.0
    below = 1.0 - np.array([item.lower_bound for item in certificates]) / best.objective
    foot = 0.07
    axes = figure.add_axes((LEFT + 0.02, foot, 0.46, top - foot - 0.045))
    for values, name, colour in (
        (above, "cost above the optimum", COLOURS[0]),
        (below, "proven bound below it", COLOURS[1]),
    ):
        axes.semilogy(np.maximum(values, 1e-16), ".-", label=name, color=colour)
    axes.set_xticks(range(0, NUM_ITERATES, 5))
    axes.set_xlabel("iteration of SOC")
    axes.set_title("both close in, relative to the optimum", fontsize=10)
    axes.legend()
    scene = figure.add_axes((0.6, foot - 0.02, 0.36, top - foot - 0.01), projection="3d")
    draw_graph(problem.graph, best.poses, scene)
    scene.set_title(f"50 poses: {best.verdict.name.lower()}", fontsize=10)
    scene.set_axis_off()


def write_page(path: Path) -> None:
    """Write the page as PDF, without the time at which it was made."""
    one_page().savefig(path, format="pdf", metadata={"CreationDate": None})


if __name__ == "__main__":
    write_page(Path(sys.argv[1]))
