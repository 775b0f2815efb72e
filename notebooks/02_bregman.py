# %% [markdown]
# # 2. Bregman iteration: why does adding the residual back make a penalty exact?
#
# Open with `jupyter lab notebooks/02_bregman.ipynb`; `pip install -e '.[notebooks,fast]'` installs
# it.
#
# The paper's section *Background of Bregman iteration* starts from equation (1),
#
# $$\min_x J(x) \quad \text{subject to} \quad \mathcal{K} x = f,$$
#
# with $J$ convex. A penalty $\frac\alpha2 \lVert \mathcal{K} x - f \rVert^2$ instead of the
# constraint gives an easier problem with a wrong solution. Bregman iteration solves the easier
# problem a few times and converges to the right solution.
#
# * **Prerequisites:** least squares, convex functions and their subgradients, and a little cvxpy.
# * **Time:** 30 minutes
# * **Next:** [notebook 3](03_bregman_is_admm.ipynb), what it costs to minimise only a little before
#   the multiplier moves.
#
# What only draws the two films is in [`drawings/bregman.py`](drawings/bregman.py).

# %%
import itertools
from dataclasses import replace

import cvxpy as cp
import matplotlib.pyplot as plt
import numpy as np
from drawings.bregman import tangent_film, tilting_film
from drawings.checks import NamedNumbers
from scipy.optimize import brentq

import solvers
from pgo_models.convex.bregman_examples import basis_pursuit, total_variation_scale_space
from pgo_models.plots.curves import plot_decay
from solvers.convex.bregman import feasibility_bound

plt.rcParams["figure.dpi"] = 150

# %% [markdown]
# ## A problem whose answer we know
#
# *Basis pursuit*: $J(x) = \lVert x \rVert_1$ finds the sparsest $x$ with $\mathcal{K} x = f$, if it
# is sparse enough. Here there are 60 unknowns, 25 equations and 5 nonzeros.

# %%
rng = np.random.default_rng(0)
K = rng.standard_normal((25, 60)) / 5.0
truth = np.zeros(60)
truth[rng.choice(60, 5, replace=False)] = rng.normal(0.0, 1.0, 5) + np.sign(rng.standard_normal(5))
f = K @ truth

# %% [markdown]
# With the penalty alone, every $\alpha$ gives an $x$ that is too small. A penalty that is a hundred
# times larger reduces the error only to a ninth.

# %%
x = cp.Variable(60)
for alpha in (1.0, 10.0, 100.0):
    cp.Problem(cp.Minimize(cp.norm1(x) + alpha / 2 * cp.sum_squares(K @ x - f))).solve(
        solver=cp.CLARABEL
    )
    print(f"alpha = {alpha:5.0f}   ||x - truth|| = {np.linalg.norm(x.value - truth):.4f}")

# %% [markdown]
# ## The iteration by hand
#
# Equation (2): let $p^k$ be a subgradient of $J$ at $x^k$, and replace $J$ by the *Bregman
# distance* $\mathcal{B}_J^{p^k}(x, x^k) = J(x) - J(x^k) - \langle p^k, x - x^k \rangle$,
# the height of $J$ above its tangent at $x^k$:
#
# $$x^{k+1} = \arg\min_x \mathcal{B}_J^{p^k}(x, x^k) + \tfrac\alpha2 \lVert \mathcal{K} x - f \rVert^2, \qquad
#   p^{k+1} = p^k - \alpha \mathcal{K}^\top (\mathcal{K} x^{k+1} - f).$$
#
# The second line is the optimality condition of the first, so $p^{k+1}$ is a subgradient at
# $x^{k+1}$ again.
#
# One unknown is enough to see what the distance does. Take $J(x) = e^x - x$ and the constraint
# $x = 2$. Since $J$ is smooth, its only subgradient is the slope $e^x - 1$, and the minimiser of
# the first line is where the slope of the sum vanishes.

# %%
target, weight = 2.0, 1.0


def slope_of_the_sum(x, p):
    return (np.exp(x) - 1.0) - p + weight * (x - target)


line_x, line_p = [0.0], [0.0]
for _ in range(10):
    line_x.append(brentq(slope_of_the_sum, 0.0, target, args=(line_p[-1],)))
    line_p.append(line_p[-1] - weight * (line_x[-1] - target))
line_x, line_p = np.array(line_x), np.array(line_p)
to_solution = np.exp(target) - target - (np.exp(line_x) - line_x) - line_p * (target - line_x)
print("x:                   ", *(f"{value:7.4f}" for value in line_x[:6]))
print("distance to solution:", *(f"{value:7.4f}" for value in to_solution[:6]))

# %% [markdown]
# In the film the green curve, distance plus penalty, has its least value at the next iterate. At
# $k = 0$ the tangent is level, so the distance is $J$ itself up to a constant, and the first step
# is the penalty method: it stops at 0.79, because $J$ pulls back. But at the new iterate the
# distance is zero and so is its slope, so nothing pulls back from there, and the next step goes
# further. The orange bar is the distance from the iterate to the solution. It becomes shorter with
# every step, which Osher et al. (2005) prove for every convex $J$.

# %%
tangent_film(line_x, line_p, target, weight)

# %% [markdown]
# Back to 60 unknowns. Terms that do not depend on $x$ can be dropped, so that only
# $-\langle p, x \rangle$ remains. $p$ is a cvxpy `Parameter`, so that cvxpy compiles the problem
# once.

# %%
alpha = 5.0
p = cp.Parameter(60)
step = cp.Problem(cp.Minimize(cp.norm1(x) - p @ x + alpha / 2 * cp.sum_squares(K @ x - f)))
accurate = {"solver": cp.CLARABEL, "tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-12}

p.value = np.zeros(60)
by_hand = []
for k in range(12):
    step.solve(**accurate)
    p.value = p.value - alpha * K.T @ (K @ x.value - f)
    by_hand.append((x.value, p.value))
    print(
        f"k = {k + 1:2}   ||K x - f|| = {np.linalg.norm(K @ x.value - f):.1e}"
        f"   ||x - truth|| = {np.linalg.norm(x.value - truth):.1e}"
    )

# %% [markdown]
# After the second step $x$ hardly approaches the solution for six more; at step 10 it is there. $J$
# is piecewise linear, so $x$ can have only finitely many sign patterns. Once the right pattern is
# found, the equations determine the rest. Until then, each step changes $p$. The error of $10^{-6}$
# that is left is the solver's: it stops within $10^{-12}$ of the least *cost*, which grows with the
# square of the error of $x$, so that $x$ is known to the root of that.
#
# With two unknowns and one equation, $x_1 + 2 x_2 = 2$, one can see this happen. The 1-norm is
# least at $x = (0, 1)$. The penalty here is so weak that alone it would leave $x$ at zero.

# %%
row, value, weak = np.array([1.0, 2.0]), 2.0, 0.07
pair, tilt, strength = cp.Variable(2), cp.Parameter(2), cp.Parameter(nonneg=True)
plane = cp.Problem(
    cp.Minimize(cp.norm1(pair) - tilt @ pair + strength / 2 * cp.square(row @ pair - value))
)

path, tilts = [np.zeros(2)], [np.zeros(2)]
strength.value = weak
for _ in range(6):
    tilt.value = tilts[-1]
    plane.solve(**accurate)
    path.append(pair.value)
    tilts.append(tilts[-1] - weak * row * (row @ pair.value - value))
path, tilts = np.array(path), np.array(tilts)

tilt.value, penalty_alone = np.zeros(2), []
for strength.value in (0.5, 1.0, 2.0, 4.0):
    plane.solve(**accurate)
    penalty_alone.append(pair.value)
print("x_2 of the iterates:      ", np.abs(path[:, 1]).round(4))
print("x_2 of the penalty alone: ", np.array(penalty_alone)[:, 1].round(4))

# %% [markdown]
# In the film the light blue lines are level lines of the Bregman distance. Each of the first three
# steps leaves $x$ at zero and only changes $p$, which tilts the 1-norm towards the constraint: its
# level lines, squares at first, stretch along the second axis. In step 4 the pull of the penalty
# exceeds what is left of the slope, and $x$ moves. From then on $p_2 = 1$: the distance is zero
# along the whole upper half of the axis, so its level lines do not close, nothing holds $x$ back,
# and step 5 reaches the constraint exactly. The orange points are the solutions of the penalty
# alone with $\alpha = 0.5, 1, 2, 4$. The last has 57 times the weight and still falls short.

# %%
tilting_film(path, tilts, row, value, np.array(penalty_alone))

# %% [markdown]
# ## Two lines
#
# Equation (4) needs no subgradient. Put $p^k = -\alpha \mathcal{K}^\top b^k$ and complete the
# square: $-\langle p^k, x \rangle = \alpha \langle b^k, \mathcal{K} x \rangle$ moves into the
# penalty,
#
# $$x^{k+1} = \arg\min_x J(x) + \tfrac\alpha2 \lVert \mathcal{K} x - f + b^k \rVert^2, \qquad
#   b^{k+1} = b^k + \mathcal{K} x^{k+1} - f.$$
#
# The remaining residual is *added back* to the data: the next subproblem asks $x$ to overshoot by
# the amount by which it fell short.
#
# *A fixed point solves the problem.* Where $b^{k+1} = b^k$, the second line says
# $\mathcal{K} x = f$. And $p = -\alpha \mathcal{K}^\top b$ is a subgradient of $J$ at $x$, so that
# for every other $y$ with $\mathcal{K} y = f$
#
# $$J(y) \;\ge\; J(x) + \langle p, y - x \rangle
#   = J(x) - \alpha \langle b, \mathcal{K} y - \mathcal{K} x \rangle = J(x).$$
#
# No $\alpha$ appears in the conclusion: the penalty decides how fast the iteration goes, not where
# it ends. This is the whole method. The $B$ of the paper's Algorithm 1 is this $b$, and its
# constraint $\mathcal{K} x = f$ is $R - \omega = 0$.

# %%
shift = cp.Parameter(25)
two_line = cp.Problem(cp.Minimize(cp.norm1(x) + alpha / 2 * cp.sum_squares(K @ x - shift)))
b = np.zeros(25)
x_differences, p_differences = [], []
for x_bregman, p_bregman in by_hand:
    shift.value = f - b
    two_line.solve(**accurate)
    b = b + K @ x.value - f
    x_differences.append(np.abs(x.value - x_bregman).max())
    p_differences.append(np.abs(-alpha * K.T @ b - p_bregman).max())
print(f"x differs by at most {max(x_differences):.0e}, p by at most {max(p_differences):.0e}")

# %% [markdown]
# ## The library agrees
#
# `solvers.iterate` yields the states of any method one by one.

# %%
problem = basis_pursuit(K, f)
for name, method in (
    ("(2)", solvers.Bregman(alpha=alpha)),
    ("(4)", solvers.TwoLineBregman(alpha=alpha)),
):
    states = list(itertools.islice(solvers.iterate(method, problem), len(by_hand) + 1))
    worst = max(
        np.abs(state.x - mine).max() for state, (mine, _) in zip(states[1:], by_hand, strict=True)
    )
    print(f"equation {name} differs from ours by at most {worst:.0e}")
result = solvers.run(solvers.TwoLineBregman(alpha=alpha), problem)
result

# %% [markdown]
# Which rate of convergence is guaranteed? With $D_0 = J(\tilde x) - \min J$ for any feasible
# $\tilde x$, Osher et al. show $\lVert \mathcal{K} x^k - f \rVert \le \sqrt{2 D_0 / (\alpha k)}$.
# This rate is slow, but it holds for every convex $J$.

# %%
D_0 = np.abs(truth).sum()
residuals = result.history.primal_residual * max(1.0, np.linalg.norm(f))
bounds = [feasibility_bound(D_0, alpha, k) for k in range(1, len(residuals))]
plot_decay([("||K x - f||", residuals), ("its bound", np.array([np.nan, *bounds]))], "residual")

# %% [markdown]
# ## Errors of earlier steps are corrected
#
# Yin and Osher noticed that errors made in the subproblems do not accumulate. Each step adds the
# current residual back, so step $k + 1$ corrects an error that step $k$ made. Below, noise of 0.1
# is added to every entry of $x$ in the first three steps. The curve with $b = 0$ throughout is the
# penalty alone. Its error does not depend on the accuracy of its subproblems and remains.

# %%
method = solvers.TwoLineBregman(alpha=alpha)
draws = np.random.default_rng(1)
errors = [draws.normal(0.0, 0.1, 60) for _ in range(3)]


def distances(errors=(), keeps_b=True):
    """||x^k - truth|| of 15 steps, of which the first ones have errors."""
    start = method.init(problem, None)
    state = start
    found = [np.linalg.norm(state.x - truth)]
    for k in range(15):
        state = method.step(problem, state)
        if k < len(errors):
            state = replace(state, x=state.x + errors[k], b=state.b + K @ errors[k])
        if not keeps_b:
            state = replace(state, b=start.b)
        found.append(np.linalg.norm(state.x - truth))
    return np.array(found)


disturbed = distances(errors)
not_added_back = distances(keeps_b=False)
curves = [
    ("Bregman iteration", distances()),
    ("disturbed in its first 3 steps", disturbed),
    ("quadratic penalty alone (b = 0)", not_added_back),
]
plot_decay(curves, "||x - truth||")

# %% [markdown]
# ## When the iterates are what we want
#
# *Total variation*, $J(u) = \sum_i |u_{i+1} - u_i|$, with $\mathcal{K} = I$ and $f$ a noisy signal.
# The solution is $u = f$, the noisy signal itself, which is useless. But the iterates start from a
# constant, then recover large jumps, and recover the noise last (Osher et al. 2005). Stop where
# $\lVert u - f \rVert$ reaches the size of the noise.

# %%
signal = np.repeat([0.0, 1.0, -0.5, 0.0, 2.0, 0.0], [20, 25, 25, 10, 10, 10])
noise_std = 0.2
noisy = signal + rng.normal(0.0, noise_std, 100)
scale_space = total_variation_scale_space(noisy)
states = list(
    itertools.islice(solvers.iterate(solvers.TwoLineBregman(alpha=0.05), scale_space), 151)
)
iterates = np.array([state.x for state in states[1:]])
to_data = np.linalg.norm(iterates - noisy, axis=1) / 10.0
to_truth = np.linalg.norm(iterates - signal, axis=1) / 10.0
stop = int(np.argmax(to_data <= noise_std))

figure, (left, right) = plt.subplots(1, 2, figsize=(7.5, 2.8), layout="constrained")
left.plot(noisy, ".", color="#999999", markersize=3, label="f, noisy")
left.plot(iterates[1], color="#56B4E9", label="iterate 2")
left.plot(iterates[stop], color="#0072B2", label=f"iterate {stop + 1}, where we stop")
left.plot(iterates[-1], color="#D55E00", linewidth=0.7, label=f"iterate {len(iterates)}")
left.set_xlabel("sample")
left.legend(fontsize=8)
right.semilogx(np.arange(1, len(iterates) + 1), to_data, color="#999999", label="to f")
right.semilogx(np.arange(1, len(iterates) + 1), to_truth, color="#0072B2", label="to the truth")
right.axvline(stop + 1, color="#0072B2", linestyle=":")
right.set_xlabel("iteration")
right.set_ylabel("root mean square distance")
_ = right.legend(fontsize=8)

# %% [markdown]
# ## Where it fails
#
# 1. As just shown, the iteration converges to the noisy signal. With a noisy $f$, the limit is not
#    what you want.
# 2. An error in the **last** step is not corrected, because no later step follows.
# 3. If no $x$ satisfies $\mathcal{K} x = f$, the residual never vanishes: $b$ grows without bound,
#    by the same amount in every step, while $x$ stays constant.
# 4. All of this is proven for convex $J$ and linear constraints. In SOC the constraint is not
#    convex; [notebook 4](04_splitting_orthogonality.ipynb) shows what still holds.

# %%
impossible = basis_pursuit(np.vstack([K[:3], K[:1]]), np.append(f[:3], f[0] + 1.0))
states = list(
    itertools.islice(solvers.iterate(solvers.TwoLineBregman(alpha=alpha), impossible), 41)
)
growth = [float(np.linalg.norm(state.b)) for state in states]
print("||b|| at k = 10, 20, 30, 40:", np.round(growth[10::10], 2))

# %% [markdown]
# ## Exercises
#
# **1.** What does the *first* step of Bregman iteration compute, with $p^0 = 0$?
#
# <details><summary>Answer</summary>
#
# The minimiser of the penalty problem, because $\mathcal{B}_J^0(x, x^0)$ is $J(x)$ plus a constant.
# The improvement begins with the second step.
#
# ```python
# first = cp.Problem(cp.Minimize(cp.norm1(x) + alpha / 2 * cp.sum_squares(K @ x - f)))
# first.solve(**accurate)
# assert np.allclose(x.value, by_hand[0][0], atol=1e-5)
# ```
#
# </details>
#
# **2.** $J$ is replaced by $10 J$. Which $\alpha$ gives the same iterates?
#
# <details><summary>Answer</summary>
#
# Ten times the old one: every subproblem and $p$ are multiplied by 10, and $b$ does not change.
#
# ```python
# y = cp.Variable(60)
# tenfold = type(problem)(10 * cp.norm1(y), y, K, f)
# third = [
#     next(itertools.islice(solvers.iterate(solvers.TwoLineBregman(alpha=a), q), 3, None)).x
#     for a, q in ((alpha, problem), (10 * alpha, tenfold))
# ]
# assert np.allclose(*third, atol=1e-5)
# ```
#
# </details>
#
# **3.** Take only the first 12 of the 25 equations. Does the iteration still converge? To the
# truth?
#
# <details><summary>Answer</summary>
#
# It converges to the smallest 1-norm under 12 equations, which is not the truth: 12 equations are
# too few for five nonzeros. The residual does not show this.
#
# ```python
# fewer = solvers.run(solvers.TwoLineBregman(alpha=alpha), basis_pursuit(K[:12], f[:12])).state.x
# assert np.linalg.norm(K[:12] @ fewer - f[:12]) < 1e-4
# assert np.abs(fewer).sum() < np.abs(truth).sum() + 1e-4
# assert np.linalg.norm(fewer - truth) > 0.1
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
    assert np.all(np.diff(to_solution) < 0.0)
    assert np.allclose(line_p, np.exp(line_x) - 1.0, atol=1e-6)
    assert np.allclose(path[1:4], 0.0, atol=1e-5)
    assert np.allclose(path[5:], [0.0, 1.0], atol=1e-5)
    assert np.isclose(tilts[4:, 1], 1.0, atol=1e-5).all()
    assert max(alone[1] for alone in penalty_alone) < 0.95
    assert max(x_differences) < 1e-5
    assert max(p_differences) < 1e-5
    assert np.linalg.norm(result.state.x - truth) < 1e-5
    assert result.status is solvers.Status.CONVERGED
    assert (residuals[1:] <= np.array(bounds) * (1 + 1e-6)).all()
    assert disturbed[-1] < 1e-4 < 0.1 < not_added_back[-1]
    assert np.all(np.diff(to_data) <= 1e-6)
    assert to_truth[stop] < 0.6 * to_truth[-1]
    assert np.allclose(states[40].x, states[20].x, atol=1e-5)
    assert np.isclose(growth[40] - growth[30], growth[30] - growth[20], rtol=1e-3)
