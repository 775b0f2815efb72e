# %% [markdown]
# # 4. How can a convex solver be made to return rotations, and how large must rho be?
#
# Open with `jupyter lab notebooks/04_splitting_orthogonality.ipynb`;
# `pip install -e '.[notebooks,fast]'` installs it.
#
# The constraint $R^\top R = I$ is the only difficulty of pose graph optimisation: without it,
# equation (16) of the paper is a least-squares problem. *Splitting of orthogonality constraints*
# (SOC, Lai and Osher 2014; the paper's Algorithm 1) gives every $R$ a copy $\omega$ that carries
# the constraint, and Bregman iteration makes the two equal.
#
# * **Prerequisites:** [notebook 2](02_bregman.ipynb), the singular value decomposition, and
#   Lagrange multipliers.
# * **Time:** 35 minutes
# * **Next:** [notebook 5](05_sdp_and_certificates.ipynb), when a convex relaxation proves that a
#   local answer is the global one.
#
# What only draws is in
# [`drawings/splitting_orthogonality.py`](drawings/splitting_orthogonality.py).

# %%
import itertools
import time

import cvxpy as cp
import matplotlib.pyplot as plt
import numpy as np
from drawings.checks import NamedNumbers
from drawings.splitting_orthogonality import (
    CircleStep,
    draw_flow_chart,
    gap_slider,
    runaway_film,
    three_step_film,
)

import pgo_models as pgo
import solvers
from pgo_models.convex.orthogonality_examples import procrustes

plt.rcParams["figure.dpi"] = 150

# %% [markdown]
# ## The one problem with orthogonality that is easy
#
# The rotation nearest to a matrix $Y$ has a closed form:
# $\lVert \omega - Y \rVert_F^2 = \text{const} - 2 \operatorname{tr}(\omega^\top Y)$. With the
# singular value decomposition $Y = U D V^\top$ we have
# $\operatorname{tr}(\omega^\top Y) = \operatorname{tr}(D \, V^\top \omega^\top U)$, where
# $V^\top \omega^\top U$ is orthogonal and none of its diagonal entries is above one. So
# $\omega = U V^\top$ is optimal. This is step (b), which the paper writes as
# $U I_{n \times n} V^\top$. If its determinant is $-1$, it is a reflection; then the sign of the
# smallest singular value changes: $\omega = U \operatorname{diag}(1, 1, -1) V^\top$.


# %%
def nearest_rotation(Y):
    U, _, Vt = np.linalg.svd(Y)
    signs = np.ones(len(Y))  # in the plane, in space, or beyond
    signs[-1] = np.linalg.det(U @ Vt)
    return U * signs @ Vt


rng = np.random.default_rng(0)
Y = rng.standard_normal((50, 3, 3))
by_svd = np.array([nearest_rotation(matrix) for matrix in Y])
print("differs from the library by", np.abs(by_svd - pgo.project_to_rotations(Y)).max())

# %% [markdown]
# *Procrustes' problem*, $\min \lVert A X - C \rVert_F^2$ s.t. $X^\top X = I$, has the same closed
# form with $Y = A^\top C$, if $X$ is square, because then $\lVert A X \rVert_F$ does not depend on
# $X$. With fewer columns than rows it does, and there is no closed form. SOC only needs a convex
# objective. It finds the closed form where there is one, and a better $X$ where there is none.


# %%
def cost_by_svd(A, C):
    U, _, Vt = np.linalg.svd(A.T @ C, full_matrices=False)
    return np.linalg.norm(A @ U @ Vt - C) ** 2


def cost_by_soc(A, C):
    return solvers.solve_orthogonal(procrustes(A, C), np.random.default_rng(0)).objective


A, C = rng.standard_normal((8, 3)), rng.standard_normal((8, 3))
closed_form, found = cost_by_svd(A, C), cost_by_soc(A, C)
print(f"X is 3 by 3: U V^T costs {closed_form:.8f}, the X of SOC {found:.8f}")
A_wide, C_thin = rng.standard_normal((30, 8)), rng.standard_normal((30, 3))
no_closed_form, found_thin = cost_by_svd(A_wide, C_thin), cost_by_soc(A_wide, C_thin)
print(f"X is 8 by 3: U V^T costs {no_closed_form:.2f}, the X of SOC {found_thin:.2f}")

# %% [markdown]
# ## Algorithm 1 by hand
#
# The paper's equation (19), and its flow chart drawn anew:
#
# $$\begin{aligned}
#   \text{(a)}\quad R &= \arg\min_R f(R) + \tfrac\rho2 \lVert R - \omega + B \rVert_F^2 \\
#   \text{(b)}\quad \omega &= \text{nearest rotation to } R + B \\
#   \text{(c)}\quad B &\leftarrow B + R - \omega
# \end{aligned}$$
#
# Here $f$ is the complete cost of equation (16) in rotations *and* translations. (The paper's step
# (a) has rotations only, and each robot keeps its neighbours fixed;
# [notebook 7](07_the_papers_tables.ipynb) runs this version.) Its residuals are linear in $X$,
# which stacks the $t_i$ and the rows of all $R_i^\top$. (a) is a convex quadratic program; cvxpy
# compiles it once, with $V = \omega - B$ as a parameter.

# %%
draw_flow_chart()

# %% [markdown]
# ## One rotation of the plane
#
# Before the whole graph, one rotation of the plane, for which all can be drawn. Such a rotation is
# given by its first column, (cosine, sine), a point of the unit circle. So here $R$, $\omega$ and
# $B$ are points and arrows of the plane, the constraint is the circle, and the rotation nearest to
# a point is the point divided by its length, which is what `nearest_rotation` returns, too. Take a
# convex quadratic cost with its minimum at $c$ inside the circle,
# $f(R) = \frac12 (R - c)^\top A (R - c)$.

# %%
turn = pgo.exp_map(np.deg2rad([25.0]))
A_plane = turn @ np.diag([2.0, 5.0]) @ turn.T
c = np.array([-0.2, 0.35])
angles = np.linspace(0.0, 2 * np.pi, 100_001)
circle = np.stack([np.cos(angles), np.sin(angles)])
costs = np.sum((circle - c[:, None]) * (A_plane @ (circle - c[:, None])), axis=0) / 2
optimum = circle[:, costs.argmin()]


def soc_on_the_circle(rho, iterations):
    omega, B = np.array([0.0, -1.0]), np.zeros(2)
    for _ in range(iterations):
        R = np.linalg.solve(A_plane + rho * np.eye(2), A_plane @ c + rho * (omega - B))  # (a)
        following = (R + B) / np.linalg.norm(R + B)  # (b)
        step = CircleStep(omega, B, R, following, B + R - following)  # (c)
        yield step
        omega, B = step.omega, step.B


settled = list(soc_on_the_circle(4.0, 8))
print(
    "omega, in degrees:",
    *(f"{np.rad2deg(np.arctan2(*step.omega[::-1])) % 360:.0f}" for step in settled),
)
print(f"the best rotation: {np.rad2deg(angles[costs.argmin()]):.0f} degrees")

# %% [markdown]
# The film has a picture for each of the three steps, here with $\rho = 4$.
#
# * (a) $R$ (blue) leaves the circle. It is a compromise between the minimum of $f$ inside and the
#   point $\omega - B$ (open circle) to which the penalty pulls it.
# * (b) The arrow $B$ (orange) is put at $R$, and its tip is moved along a radius to the circle.
#   That is the new $\omega$ (green).
# * (c) The new $B$ is what was cut off in (b): it leads from $\omega$ to the tip.
#
# In the next (a) the penalty pulls $R$ to $\omega - B$, which is as far from $\omega$ as the tip of
# the arrow, but on the other side. So $B$ changes until the pull of the penalty balances the slope
# of $f$ across the circle, and $R$ and $\omega$ meet *on* the circle. The arrow remains: it is
# $-\lambda / \rho$ times $\omega$, where $\lambda$ is the multiplier of the constraint.

# %%
three_step_film(settled, A_plane, c, optimum)

# %% [markdown]
# ## The whole graph by hand
#
# Now the poses of a graph in space. Step (a) is the convex quadratic program over all of them.

# %%
problem = pgo.PGOProblem(pgo.load("grid"))
n, d, rho = problem.num_poses, problem.d, 12.0
start = pgo.chordal_start(problem)

residuals, w = problem.residual_matrix
X, V = cp.Variable((problem.side, d)), cp.Parameter((n * d, d))
edges = cp.sum_squares(cp.multiply(np.sqrt(w)[:, None], residuals @ X))
step_a = cp.Problem(cp.Minimize(edges + rho / 2 * cp.sum_squares(X[n:] - V)))

omega, B = start.R, np.zeros((n, d, d))
by_hand = []
for _ in range(20):
    V.value = (omega - B).transpose(0, 2, 1).reshape(n * d, d)
    step_a.solve(solver=cp.CLARABEL)
    R = X.value[n:].reshape(n, d, d).transpose(0, 2, 1)
    omega = np.array([nearest_rotation(matrix) for matrix in R + B])
    B = B + R - omega
    by_hand.append(omega)

# %% [markdown]
# ## The library agrees, with three back ends
#
# A convex QP without constraints is a linear system: $(M + \tfrac\rho2 D) X = \tfrac\rho2 D V$,
# with the same matrix at every iteration. One can factor it once (`FACTORIZED`), use the accelerated
# gradients of the paper (`FISTA`, Beck and Teboulle 2009), or use an interior-point method
# (`CLARABEL`).

# %%
best = solvers.solve(problem)
plain = {"penalty": solvers.FixedPenalty(rho), "acceleration": None}
differences, seconds = {}, {}
for back_end in solvers.RStep:
    began = time.perf_counter()
    states = list(
        itertools.islice(solvers.iterate(solvers.SOC(r_step=back_end, **plain), problem), 21)
    )
    seconds[back_end] = time.perf_counter() - began
    pairs = zip(states[1:], by_hand, strict=True)
    differences[back_end] = max(np.abs(state.omega - mine).max() for state, mine in pairs)
    print(
        f"{back_end.name:10}  differs from ours by {differences[back_end]:.0e}   {1e3 * seconds[back_end]:.0f} ms"
    )

# %% [markdown]
# The iterates do not depend on the back end, but the time does. Two triangular solves are the
# fastest, because the matrix never changes. Gradients are useful where it cannot be factored, and
# Clarabel where you add constraints or terms to step (a) (`solvers.ExtendedSOC`).
#
# ## How large must rho be?
#
# At a stationary point, (a) gives $2 (M X)_i + \rho (R_i - \omega_i + B_i)^\top = 0$ for the rows
# of pose $i$, and $(M X)_i = \Lambda_i R_i^\top$ with the symmetric multipliers $\Lambda_i$ of
# $R_i R_i^\top = I$. With $R = \omega$:
#
# $$B_i = -\tfrac{2}{\rho} R_i \Lambda_i, \qquad R_i + B_i = R_i \left( I - \tfrac2\rho \Lambda_i \right).$$
#
# Step (b) must return $R_i$. The rotation nearest to a symmetric 3 by 3 matrix is $I$ if and only
# if the sum of its two smallest eigenvalues is $\ge 0$. With $\lambda_1 \ge \lambda_2$, the two
# largest eigenvalues of $\Lambda_i$, this condition is
#
# $$\rho \ge \lambda_1(\Lambda_i) + \lambda_2(\Lambda_i) \quad \text{for every pose } i.$$
#
# **With a smaller $\rho$ the optimum is not even a fixed point**: the recursion cannot stay there.
# To see this, start at the optimum and take one step.


# %%
def soc_step(omega, B, rho):
    """One iteration, rho for every pose, (n,); t_0 is held at the origin."""
    diagonal = np.concatenate([np.zeros(n), np.repeat(rho, d)]) / 2
    matrix = problem.M.toarray() + np.diag(diagonal)
    matrix[0, 0] *= 2
    V = np.concatenate([np.zeros((n, d)), (omega - B).transpose(0, 2, 1).reshape(n * d, d)])
    R = np.linalg.solve(matrix, diagonal[:, None] * V)[n:].reshape(n, d, d).transpose(0, 2, 1)
    following = pgo.project_to_rotations(R + B)
    return following, B + R - following


Lambda = pgo.multipliers(problem, best.poses)
eigenvalues = np.linalg.eigvalsh(Lambda)
threshold = eigenvalues[:, -1] + eigenvalues[:, -2]
moved = {}
for factor in (0.5, 0.9, 0.99, 1.01, 1.1, 2.0):
    B_star = -2 * best.poses.R @ Lambda / (factor * threshold)[:, None, None]
    omega, _ = soc_step(best.poses.R, B_star, factor * threshold)
    moved[factor] = np.abs(omega - best.poses.R).max()
    print(
        f"rho = {factor:4.2f} (lambda_1 + lambda_2): one step away from the optimum moves omega by {moved[factor]:.0e}"
    )

# %% [markdown]
# The condition is sharp.
#
# On the circle above there is one multiplier: at the optimum the slope of $f$ points outwards,
# $A (R - c) = \lambda R$, and the same lines give $R + B = (1 - \lambda / \rho) R$. With
# $\rho < \lambda$ this is a point beyond the middle of the circle, and (b) sends it to the opposite
# rotation. Above, $\rho$ was about $2 \lambda$. The next film has $\rho = 0.6\,\lambda$, the same
# start, and a picture for each iteration; a grey arc is the way of $\omega$.

# %%
multiplier = optimum @ A_plane @ (optimum - c)
lost = list(soc_on_the_circle(0.6 * multiplier, 24))
from_optimum = [np.rad2deg(np.arccos(step.omega @ optimum)) for step in lost]
print(f"lambda = {multiplier:.2f}")
print("degrees from the optimum:", *(f"{angle:.0f}" for angle in from_optimum))
runaway_film(lost, A_plane, c, optimum)

# %% [markdown]
# The first iteration happens to arrive close to the optimum, within about a degree, and then the
# point runs away. It cannot stay, because no $B$ would hold it there.
#
# The condition is necessary but not sufficient, because a fixed point need not be attractive. Here
# is the graph again, from the chordal initial estimate:


# %%
def gaps(rho, iterations=120):
    omega, B, found = start.R, np.zeros((n, d, d)), []
    for _ in range(iterations):
        omega, B = soc_step(omega, B, rho)
        found.append(problem.objective(problem.with_best_translations(omega)) / best.objective - 1)
    return np.maximum(np.array(found), 1e-14)


factors = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 8.0, 16.0, 64.0)
curves = {factor: gaps(factor * threshold) for factor in factors}
print("rho / (lambda_1 + lambda_2)   least gap   gap at the end")
for factor, gap in curves.items():
    print(f"{factor:27g}   {gap.min():9.0e}   {gap[-1]:14.0e}")

# %% [markdown]
# The slider goes over $\rho$. The thick curve is the run with the $\rho$ of the label; it is red if
# it does not come to the optimum. The thin grey curves are the other runs. Gaps below $10^{-14}$
# are rounding errors, and are drawn there.

# %%
gap_slider(curves)

# %% [markdown]
# On this graph:
#
# * Up to 1.5 the run never converges to the optimum. At 1.5 it first comes within $10^{-5}$ of it
#   and then moves away again: *a small residual during the run does not prove convergence.*
# * At 2 the gap is the first below $10^{-8}$, after 22 iterations. A larger $\rho$ only makes the
#   steps shorter, and from 4 on the number of iterations grows about as $\rho$ does.
#
# The multipliers, which cost one product with $M$, tell where the best $\rho$ is. The library's
# default, `MultiplierPenalty`, takes $\rho_i = 8 \max(\lVert \Lambda_i \rVert, q\, m_i)$ at the
# chordal initial estimate. This is somewhat larger than necessary, for safety, and each pose has
# its own $\rho$, because the multipliers differ. Anderson acceleration compensates for the cost.

# %%
everyday = {
    "multiplier penalty": solvers.SOC(acceleration=None),
    "... accelerated (the default)": solvers.SOC(),
    "fixed rho = 1000": solvers.SOC(penalty=solvers.FixedPenalty(1000.0), acceleration=None),
    "fixed rho = 1": solvers.SOC(penalty=solvers.FixedPenalty(1.0), acceleration=None),
}
runs = {name: solvers.run(soc, problem) for name, soc in everyday.items()}
for name, run in runs.items():
    print(
        f"{name:30} {run.status.name:15} {run.iterations:4} iterations, rho at the end {run.state.rho.mean():.3g}"
    )

# %% [markdown]
# The last line requested $\rho = 1$ and ended with 8: where the residual grows far above its
# smallest value, the library returns to the best iterate and doubles $\rho$, keeping $\rho B$.
#
# ## Where it fails
#
# 1. $\rho$ is below the threshold, as above.
# 2. A limit of SOC is a *stationary point*. In a convex problem that would be a minimum, but the
#    set of rotations is not convex. On the ring of [notebook 1](01_quickstart.ipynb), started where
#    the chain winds around the ring twice, SOC stays there, and its residuals become as small as
#    anywhere else.

# %%
count = 30
ring = pgo.PoseGraph(
    num_poses=count,
    i=np.arange(count),
    j=(np.arange(count) + 1) % count,
    R_ij=pgo.exp_map(np.full((count, 1), 2 * np.pi / count)),
    t_ij=np.tile([1.0, 0.0], (count, 1)),
    kappa=np.full(count, 100.0),
    tau=np.full(count, 100.0),
    name="ring",
)
ring_problem = pgo.PGOProblem(ring)
twice = ring_problem.with_best_translations(
    pgo.exp_map(4 * np.pi / count * np.arange(count)[:, None])
)
stuck = solvers.run(solvers.SOC(acceleration=None), ring_problem, twice)
print(stuck)
solvers.certify(ring_problem, stuck.poses)

# %% [markdown]
# CONVERGED is about the residuals, TRIVIAL about the cost. The measurements of this ring have no
# noise, so that the least cost is zero, and no lower bound can be better than zero. Zero is a bound
# that every graph has without any proof, hence the name TRIVIAL. The gap of 1 says that, as far as
# this bound can tell, all of the cost could be saved. Here it could: the chain that winds around
# once has $F = 0$.

# %% [markdown]
# ## Exercises
#
# **1.** $Y = \operatorname{diag}(1, 1, -0.1)$. Which rotation is nearest, and how much farther away
# is it than the nearest orthogonal matrix?
#
# <details><summary>Answer</summary>
#
# $I$, at a distance of 1.1, because the sign of the smallest singular value changes. The nearest
# orthogonal matrix is the reflection $\operatorname{diag}(1, 1, -1)$, at a distance of 0.9.
#
# ```python
# flipped = np.diag([1.0, 1.0, -0.1])
# assert np.allclose(nearest_rotation(flipped), np.eye(3))
# others = pgo.random_rotations(1000, 3, np.random.default_rng(1))
# assert np.linalg.norm(others - flipped, axis=(1, 2)).min() >= 1.1
# ```
#
# </details>
#
# **2.** All weights are multiplied by 100. Which $\rho$ gives the same $\omega$?
#
# <details><summary>Answer</summary>
#
# 100 times the old one: (a) is multiplied by 100 and $B$ does not change. So $\rho$ has the unit of
# the weights, and a fixed default value must be wrong for some graph. The multipliers scale with
# the weights.
#
# ```python
# light = problem.graph
# heavy = pgo.PGOProblem(light.with_weights(100 * light.kappa, 100 * light.tau))
# found_by = []
# for r, weighted in ((12.0, problem), (1200.0, heavy)):
#     fixed = solvers.SOC(penalty=solvers.FixedPenalty(r), acceleration=None)
#     found_by.append(list(itertools.islice(solvers.iterate(fixed, weighted), 6))[-1].omega)
# assert np.allclose(*found_by, atol=1e-8)
# ```
#
# </details>
#
# **3.** Start SOC at the certified optimum. Does it stay there?
#
# <details><summary>Answer</summary>
#
# No. It begins with $B = 0$, but the optimum is a fixed point only with its multiplier, $\rho B$.
# The iterates move away and return.
#
# ```python
# film = list(itertools.islice(solvers.iterate(solvers.SOC(**plain), problem, best.poses), 200))
# moved_by = [problem.objective(problem.with_best_translations(state.omega)) / best.objective - 1 for state in film]
# assert max(moved_by) > 1e-6 > 100 * abs(moved_by[-1])
# ```
#
# </details>

# %% [markdown]
# ## Checks of the numbers above
#
# The last cell checks the statements of this notebook. A reader who has changed parameters may skip
# it.

# %%
with NamedNumbers():
    assert np.allclose(by_svd, pgo.project_to_rotations(Y))
    assert np.isclose(found, closed_form, rtol=1e-6)
    assert found_thin < 0.9 * no_closed_form
    assert max(differences.values()) < 1e-6
    assert min(moved[factor] for factor in (0.5, 0.9, 0.99)) > 0.1
    assert max(moved[factor] for factor in (1.01, 1.1, 2.0)) < 1e-4
    assert curves[1.0][-1] > 0.1
    assert curves[1.5].min() < 1e-2 < curves[1.5][-1]
    assert curves[2.0][-1] < 1e-9 < curves[16.0][-1]
    assert runs["... accelerated (the default)"].iterations < runs["multiplier penalty"].iterations
    assert np.isclose(runs["fixed rho = 1"].objective, best.objective, rtol=1e-6)
    assert stuck.status is solvers.Status.CONVERGED
    assert stuck.objective > 100.0
    assert solvers.solve(ring_problem).objective < 1e-12 * stuck.objective
    assert np.allclose(nearest_rotation(np.diag([2.0, -1.0])), np.eye(2))
    assert np.allclose(settled[-1].omega, optimum, atol=0.02)
    assert np.allclose(
        [nearest_rotation(np.array([[x, -y], [y, x]]))[:, 0] for x, y in Y[:, 0, :2]],
        [point / np.linalg.norm(point) for point in Y[:, 0, :2]],
    )
    assert min(from_optimum) < 2.0
    assert max(from_optimum[-8:]) > 90.0
