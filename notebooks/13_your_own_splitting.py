# %% [markdown]
# # 13. How do you write a splitting method of your own?
#
# Open with `jupyter lab notebooks/13_your_own_splitting.ipynb`;
# `pip install -e '.[notebooks,fast]'` installs it.
#
# - **Prerequisites:** [notebook 4](04_splitting_orthogonality.ipynb), which derives the method SOC that
#   is written anew here
# - **Time:** 25 minutes
# - **Next:** [notebook 14](14_is_it_really_the_best.ipynb), whether an answer is really the best
#
# A splitting method is a recursion of a few lines. What surrounds it is the same for every method:
# a loop, a clock, a table, a history, a test of convergence, limits, the best iterate. The library
# has these once. You write the recursion, or one part of it: step (a), the penalty, the set, a
# constraint. The guide page [*Your own splitting method*](site/guide/own_splitting.md) lists these
# parts, and what each of them must have.

# %%
import itertools
from dataclasses import dataclass, replace

import cvxpy as cp
import matplotlib.pyplot as plt
import numpy as np
from drawings.checks import NamedNumbers
from scipy.optimize import linear_sum_assignment
from scipy.sparse.linalg import splu

import pgo_models as pgo
import solvers
from pgo_models.plots.curves import plot_decay

plt.rcParams["figure.dpi"] = 150

graph = pgo.load("grid")
problem = pgo.PGOProblem(graph)
best = solvers.solve(problem)

# %% [markdown]
# ## The whole method
#
# SOC splits every rotation in two: a matrix $R_i$ that enters the cost, and a rotation $\omega_i$,
# with the constraint $R_i = \omega_i$ and its scaled multiplier $B_i$. One iteration is
#
# $$\begin{aligned}
#   (R, t) &= \arg\min F(R, t) + \tfrac{\rho}{2} \lVert R - \omega + B \rVert^2 && \text{(a)} \\
#   \omega &= \text{the rotations nearest to } R + B && \text{(b)} \\
#   B &\leftarrow B + R - \omega && \text{(c)}
# \end{aligned}$$
#
# What is carried from one iteration to the next is a *state*: the compiled step (a), $\omega$, $B$,
# and the two residuals. `graph_qp` compiles step (a) for a given $\rho$.


# %%
@dataclass(frozen=True, eq=False)
class State:
    step_a: pgo.GraphQP
    omega: np.ndarray
    B: np.ndarray
    residuals: tuple = (np.inf, np.inf)


# %% [markdown]
# A *method* is settings with `init`, `step`, `measure` and `converged`; one for pose graphs has
# `poses`, too. This is the whole of it, in less than 30 lines. `step` returns a new state and
# leaves the old one alone. The unknown of step (a) has the rows $t_i$ and then the rows of every
# $R_i^\top$.


# %%
@dataclass(frozen=True)
class MySplitting:
    rho: float = 12.0
    tolerance: float = 1e-5
    max_iterations: int = 500

    def init(self, problem: pgo.PGOProblem, start: pgo.Poses | None) -> State:
        start = pgo.chordal_start(problem) if start is None else start
        return State(pgo.graph_qp(problem, self.rho), start.R, np.zeros_like(start.R))

    def step(self, problem, state):
        n, d, _ = state.omega.shape
        rows_of_R = np.swapaxes(state.omega - state.B, 1, 2).reshape(d * n, d)
        X = state.step_a.solve(np.concatenate([np.zeros((n, d)), rows_of_R]))  # (a)
        R = np.swapaxes(X[n:].reshape(n, d, d), 1, 2)
        omega = pgo.project_to_rotations(R + state.B)  # (b)
        B = state.B + R - omega  # (c)
        size = np.sqrt(d * n)
        residuals = np.linalg.norm(R - omega) / size, np.linalg.norm(omega - state.omega) / size
        return replace(state, omega=omega, B=B, residuals=residuals)

    def poses(self, problem, state):
        return problem.with_best_translations(state.omega)

    def measure(self, problem, state):
        return solvers.Measurement(problem.objective(self.poses(problem, state)), *state.residuals)

    def converged(self, state, measurement):
        return solvers.Status.CONVERGED if max(state.residuals) <= self.tolerance else None


# %% [markdown]
# `run` takes it as it takes the library's methods, with a graph or a problem. The annotations of
# `init` say what it can be given: `run(MySplitting(), "grid")` is answered with one sentence.

# %%
mine = solvers.run(MySplitting(), graph)
print(mine)
print(solvers.certify(problem, mine.poses))

# %%
try:
    solvers.run(MySplitting(), "grid")
except pgo.PGOError as error:
    print(error)

# %% [markdown]
# ## The library agrees
#
# `SOC` with one penalty for all poses and without acceleration has the same iterates.

# %%
plain = solvers.SOC(penalty=solvers.FixedPenalty(12.0), acceleration=None)
states, states_of_soc = (
    list(itertools.islice(solvers.iterate(method, graph), 12)) for method in (MySplitting(), plain)
)
differences = [
    np.abs(own.omega - soc.omega).max() for own, soc in zip(states, states_of_soc, strict=True)
]
print(f"largest difference of omega over 12 iterates: {max(differences):.0e}")

# %% [markdown]
# The residuals of both, and of SOC with all that it has besides:

# %%
accelerated = solvers.run(solvers.SOC(), graph)
plot_decay(
    [
        ("mine", mine.history.primal_residual[1:]),
        ("SOC, as it is", accelerated.history.primal_residual[1:]),
    ],
    "||R - omega||",
)

# %% [markdown]
# As `step` leaves its state alone, a list of states is a film of the run. `solvers.film` takes any
# method that has `poses`, and proves a lower bound at every iterate that it shows. This graph of 20
# poses in the plane needs a larger $\rho$.

# %%
flat = pgo.random_geometric(20, np.random.default_rng(1), d=2)
solvers.film(flat, [MySplitting(rho=100.0, tolerance=1e-3)])

# %% [markdown]
# ## A part of it
#
# Often one part is enough, and the rest of SOC stays: several penalties, Anderson acceleration, the
# safeguard. **Step (a)** is any object with `prepare`, which returns one with `solve`. Here it is
# SciPy's sparse LU of $K = M + D / 2$:


# %%
@dataclass(frozen=True, eq=False)
class Factor:
    lu: object
    half_penalty: np.ndarray

    def solve(self, V):
        return self.lu.solve(self.half_penalty * V)


class LUStep:
    def prepare(self, subproblem):
        return Factor(splu(subproblem.matrix), 0.5 * subproblem.rho[:, None])


by_lu = solvers.run(solvers.SOC(r_step=LUStep()), graph)
by_cholesky = solvers.run(solvers.SOC(), graph)
print(by_lu, by_cholesky, sep="\n")

# %% [markdown]
# **The penalty** is any object with two methods. `bounds` gives three numbers $(p, q, r)$, so that
# the penalties begin at $\rho_i = \max(p \lVert \Lambda_i \rVert, q\, m_i, r)$, with the multiplier
# $\Lambda_i$ of a pose and the mean diagonal $m_i$ of $M$ over its rows. `rescaling` gives the factor
# by which all of them move before the next step, from the two residuals.


# %%
class Doubling:
    def bounds(self, ratio):
        return 0.0, 0.3, 0.0

    def rescaling(self, primal_residual, dual_residual):
        return 2.0 if dual_residual > 0.05 else 1.0


doubled = solvers.run(solvers.SOC(penalty=Doubling()), graph)
print(doubled)

# %% [markdown]
# $\rho$ is data of the compiled step (a), not a `cp.Parameter` of it: a new $\rho$ compiles the program
# anew. As a Parameter it would obey cvxpy's rules for parameters (DPP), but compiling would hold
# the product of all parameters with all entries, tens of gigabytes on 2500 poses. So a rule should
# move
# $\rho$ seldom.
#
# **The set** needs its projection alone. A signed permutation has one entry of $-1$ or $1$ in every
# row and column; the nearest one is an assignment problem. With it SOC finds how the axes of two
# sensors correspond:


# %%
class SignedPermutations(pgo.ConstraintSet):
    def project(self, V):
        rows, columns = linear_sum_assignment(-np.abs(V))
        P = np.zeros(V.shape)
        P[rows, columns] = np.where(V[rows, columns] < 0, -1.0, 1.0)
        return P


rng = np.random.default_rng(3)
hidden = SignedPermutations().project(rng.standard_normal((4, 4)))
readings = rng.standard_normal((4, 30))
seen = hidden @ readings + 0.1 * rng.standard_normal((4, 30))

X = cp.Variable((4, 4))
mismatch = cp.Problem(cp.Minimize(cp.norm1(X @ readings - seen)))
axes = solvers.solve_orthogonal(
    pgo.OrthogonalProblem(mismatch, sets=[(X, SignedPermutations())]), 0
)
print(axes)
print(axes.values[0].astype(int))

# %% [markdown]
# **A constraint** is written on the poses, and has its dual value after the run. The dual value is
# a price: by how much $F$ rises where the constraint is tightened by one unit.

# %%
e = int(np.argmax(best.edge_residuals.translation))
error = float(best.edge_residuals.translation[e])
written = []


def shorter(unknown):
    written.append(cp.norm(unknown.translation_residual(e)) <= 0.7 * error)
    return pgo.ModelChange(constraints=[written[-1]])


tightened = solvers.run(solvers.ExtendedSOC(shorter), problem)
price = float(written[0].dual_value)
print(
    f"edge {e} at most {0.7 * error:.2f} m: F {best.objective:.2f} becomes {tightened.objective:.2f}"
)
print(f"one centimetre less would cost {0.01 * price:.2f} more")

# %% [markdown]
# ## Where it fails
#
# A $\rho$ that is too small does not converge ([notebook 4](04_splitting_orthogonality.ipynb) says
# how large it must be), and `MySplitting` has nothing to notice it. With the $\rho$ of the first
# graph, the run on the second one ends without convergence; `run` returns the best of its iterates
# and says so. SOC chooses $\rho$ for every pose from its multiplier.

# %%
too_small = solvers.run(MySplitting(rho=12.0), flat)
by_soc = solvers.run(solvers.SOC(), flat)
print(too_small, by_soc, sep="\n")

# %% [markdown]
# The sets are not convex, so CONVERGED says that the residuals are small and not that the point is
# the best one. Here are the costs at which ten starts end for a harder problem, in which the
# sensors measure little, without noise:

# %%
short = readings[:, :3]
Y = cp.Variable((4, 4))
harder = cp.Problem(cp.Minimize(cp.norm1(Y @ short - hidden @ short)))
ends = solvers.solve_orthogonal(
    pgo.OrthogonalProblem(harder, sets=[(Y, SignedPermutations())]), 0, starts=10
)
print(ends)
print(f"J of the hidden permutation {ends.problem.objective([hidden]):g}")

# %% [markdown]
# All ten have converged, and none is at the hidden permutation, which costs nothing. The solution
# says that it has no lower bound, in contrast to pose graphs, where `certify` gives one. Several
# starts are all there is.

# %% [markdown]
# ## Exercises
#
# **1.** Add over-relaxation to `MySplitting`: in (b) and (c), $1.6 R - 0.6\, \omega$ takes the
# place of
# $R$. Does it need fewer iterations?
#
# <details><summary>Answer</summary>
#
# The fixed points are the same, and here the iterations are fewer. The library's setting is
# `SOC(alpha=1.6)`.
#
# ```python
# relaxed = solvers.run(replace(plain, alpha=1.6), graph)
# assert relaxed.status is solvers.Status.CONVERGED
# assert relaxed.iterations < solvers.run(plain, graph).iterations
# ```
#
# </details>
#
# **2.** Write the set of matrices of rank one. Which rank-one matrix is nearest to a given one?
#
# <details><summary>Answer</summary>
#
# The first term of the singular value decomposition.
#
# ```python
# class RankOne(pgo.ConstraintSet):
#     def project(self, V):
#         U, s, Vt = np.linalg.svd(V)
#         return s[0] * np.outer(U[:, 0], Vt[0])
#
# Z = cp.Variable((3, 3))
# target = np.diag([3.0, 2.0, 1.0])
# nearest = cp.Problem(cp.Minimize(cp.sum_squares(Z - target)))
# low = solvers.solve_orthogonal(pgo.OrthogonalProblem(nearest, sets=[(Z, RankOne())]), 0)
# assert np.isclose(low.objective, 5.0, atol=1e-4)
# ```
#
# </details>
#
# **3.** What does `solvers.run(solvers.SOC(penalty=..), graph)` say of a rule whose `bounds`
# returns two numbers?
#
# <details><summary>Answer</summary>
#
# One sentence with what is needed.
#
# ```python
# class Short(Doubling):
#     def bounds(self, ratio):
#         return 1.0, 2.0
#
# try:
#     solvers.run(solvers.SOC(penalty=Short()), graph)
# except pgo.PGOError as error:
#     assert "give three numbers" in str(error)
# ```
#
# </details>

# %% [markdown]
# ## Checks of the numbers above
#
# Readers who have changed parameters may skip this cell, which holds for those given.

# %%
with NamedNumbers():
    assert mine.status is solvers.Status.CONVERGED
    assert np.isclose(mine.objective, best.objective, rtol=1e-6)
    assert max(differences) < 1e-6
    assert by_lu.iterations == by_cholesky.iterations
    assert np.isclose(doubled.objective, best.objective, rtol=1e-6)
    assert np.array_equal(axes.values[0], hidden)
    assert len(written) == 1
    assert price > 0.0
    assert tightened.objective > best.objective
    assert too_small.status is not solvers.Status.CONVERGED
    assert by_soc.status is solvers.Status.CONVERGED
    assert ends.status is solvers.Status.CONVERGED
    assert ends.problem.objective([hidden]) == 0.0 < 1.0 < ends.objective
