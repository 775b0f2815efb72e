# %% [markdown]
# # 3. ADMM is Bregman iteration: what does it cost to minimise only a little before the multiplier moves?
#
# Open with `jupyter lab notebooks/03_bregman_is_admm.ipynb`; `pip install -e '.[notebooks,fast]'`
# installs it.
#
# The paper's subsection *Equivalence to ADMM* iterates the minimisation of the augmented Lagrangian
# $T$ times and then updates the multiplier; with $T = 1$ this is ADMM. Does $T = 1$ cost
# iterations? This notebook counts them.
#
# * **Prerequisites:** [notebook 2](02_bregman.ipynb), Lagrange multipliers, and soft thresholding.
# * **Time:** 30 minutes
# * **Next:** [notebook 4](04_splitting_orthogonality.ipynb), how a convex solver is made to return
#   rotations.
#
# What only draws is in [`drawings/bregman_is_admm.py`](drawings/bregman_is_admm.py).

# %%
import itertools

import matplotlib.pyplot as plt
import numpy as np
from drawings.bregman_is_admm import draw_adaptive, draw_counts, draw_residuals, spiral_film
from drawings.checks import NamedNumbers

import pgo_models as pgo
import solvers
from pgo_models.convex.bregman_examples import basis_pursuit, total_variation_denoising

plt.rcParams["figure.dpi"] = 150

# %% [markdown]
# ## Three names of one iteration
#
# The augmented Lagrangian of $\min J(x)$ s.t. $\mathcal{K} x = f$ is
#
# $$\mathcal{L}_\alpha(x, \lambda) = J(x) + \langle \lambda, f - \mathcal{K} x \rangle
#   + \tfrac\alpha2 \lVert f - \mathcal{K} x \rVert^2,$$
#
# and the *method of multipliers* (the paper's equation (8)) is
# $x^{k+1} = \arg\min_x \mathcal{L}_\alpha(x, \lambda^k)$,
# $\lambda^{k+1} = \lambda^k + \alpha (f - \mathcal{K} x^{k+1})$. Completing the square with
# $b = -\lambda / \alpha$ gives the two-line form, equation (4), of [notebook 2](02_bregman.ipynb).
# With $p = \mathcal{K}^\top \lambda$ it is equation (2). The forms are equivalent without any
# approximation, so all three give the same numbers.

# %%
rng = np.random.default_rng(0)
pursuit = basis_pursuit(rng.standard_normal((8, 20)), rng.standard_normal(8))
forms = [solvers.Bregman(), solvers.TwoLineBregman(), solvers.MethodOfMultipliers()]
runs = [list(itertools.islice(solvers.iterate(form, pursuit), 6)) for form in forms]
for bregman, two_line, multiplier in zip(*runs, strict=True):
    p = [bregman.p, -pursuit.K.T @ two_line.b, pursuit.K.T @ multiplier.lam]
    x = [bregman.x, two_line.x, multiplier.x]
    print(
        f"k = {multiplier.k}   x differs by {np.ptp(x, axis=0).max():.0e}, p by {np.ptp(p, axis=0).max():.0e}"
    )

# %% [markdown]
# ## Two blocks
#
# The minimisation over all of $x$ at once can be as hard as the original problem. Split $x$ into
# blocks for which it is easy. *Total variation denoising* of a signal $f$:
#
# $$\min_{u, d} \tfrac12 \lVert u - f \rVert^2 + w \lVert d \rVert_1 \quad \text{subject to} \quad D u - d = 0.$$
#
# The minimisation over $u$ alone is a linear system, and over $d$ alone it is soft thresholding.
# The code does $T$ passes over both blocks, and then updates the multiplier in its scaled form $b$:


# %%
signal = np.repeat([0.0, 1.0, -0.5, 0.0, 2.0, 0.0], [20, 25, 25, 10, 10, 10])
noisy = signal + 0.2 * rng.standard_normal(100)
weight = 0.5
D = np.diff(np.eye(100), axis=0)


def alternate(alpha, passes, iterations):
    d, b = np.zeros(99), np.zeros(99)
    inverse = np.linalg.inv(np.eye(100) + alpha * D.T @ D)
    for _ in range(iterations):
        for _ in range(passes):
            d_before = d
            u = inverse @ (noisy + alpha * D.T @ (d - b))
            v = D @ u + b
            d = np.sign(v) * np.maximum(np.abs(v) - weight / alpha, 0.0)
        b = b + D @ u - d
        yield u, d, b, np.linalg.norm(D @ u - d), alpha * np.linalg.norm(D.T @ (d - d_before))


# %% [markdown]
# The last two numbers are the residuals (Boyd et al. 2011, section 3.3). The *primal* residual
# measures the violation of the constraint. The *dual* residual measures how far $(u, d)$ is from
# minimising the Lagrangian, because $u$ was computed with the old $d$.
#
# ## The library agrees
#
# `AlternatingBregman` does not use soft thresholding: it solves each block with cvxpy and Clarabel.
# Its states are the same.

# %%
denoising = total_variation_denoising(noisy, weight)
worst_difference = {}
for T in (1, 3):
    states = list(
        itertools.islice(
            solvers.iterate(solvers.AlternatingBregman(alpha=1.0, passes=T), denoising), 16
        )
    )
    ours = list(alternate(1.0, T, 15))
    worst_difference[T] = max(
        np.abs(state.x - np.concatenate([u, d])).max()
        for state, (u, d, *_) in zip(states[1:], ours, strict=True)
    )
    print(f"T = {T}: the same to {worst_difference[T]:.0e} in 15 iterations")

# %% [markdown]
# ## T against alpha
#
# Count the outer iterations, and the total number of inner passes, until both residuals are below
# $10^{-4}$.


# %%
def residuals(alpha, passes, most=3000):
    pairs = []
    for *_, primal, dual in alternate(alpha, passes, most):
        pairs.append((primal, dual))
        if max(primal, dual) < 1e-4:
            break
    return np.array(pairs)


penalties, all_passes = [0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0], (1, 2, 5, 20)
counts = np.array(
    [[len(residuals(alpha, T)) for alpha in penalties] for T in all_passes], dtype=float
)
counts[counts == 3000] = np.nan  # not within the limit
draw_counts(penalties, dict(zip(all_passes, counts, strict=True)))

# %% [markdown]
# There are two regimes, and a large $T$ does not pay in either of them:
#
# * **small penalty** (left of the minimum): each iteration changes the multiplier by $\alpha$ times
#   the residual, and this limits the speed. One pass already minimises well enough, and more passes
#   only add work.
# * **large penalty** (right of the minimum): the penalty couples the blocks strongly, and the
#   passes limit the speed. $T$ passes save a factor $T$ of outer iterations, so the number of
#   passes is the same.
#
# So $T = 1$ costs nothing. For robots, where a pass is a round of messages, it is the natural
# choice. The choice of $\alpha$ matters more. Here are the residuals for three values of it.

# %%
draw_residuals({alpha: residuals(alpha, 1, most=120) for alpha in (0.1, 3.0, 100.0)})

# %% [markdown]
# ## The adaptive penalty
#
# The picture explains the rule that the paper takes from Boyd et al. (section 3.4.1) in its
# subsection *The SOC Algorithm*: with a small penalty the primal residual is far above the dual
# one, with a large penalty far below. So the rule doubles $\alpha$ when $r > \mu s$ and halves it
# when $s > \mu r$; Boyd et al. suggest $\mu = 10$. One line is easily forgotten:
# $b = -\lambda / \alpha$ is *scaled*. When $\alpha$ changes, $b$ must be divided by the same
# factor, so that $\lambda$ does not change.


# %%
def adaptive(alpha, mu, rescale, most=1000):
    """Penalty and larger residual of every iteration."""
    d, b = np.zeros(99), np.zeros(99)
    trace = []
    while len(trace) < most and (not trace or trace[-1][1] >= 1e-4):
        d_before = d
        u = np.linalg.solve(np.eye(100) + alpha * D.T @ D, noisy + alpha * D.T @ (d - b))
        v = D @ u + b
        d = np.sign(v) * np.maximum(np.abs(v) - weight / alpha, 0.0)
        b = b + D @ u - d
        primal, dual = np.linalg.norm(D @ u - d), alpha * np.linalg.norm(D.T @ (d - d_before))
        trace.append((alpha, max(primal, dual)))
        factor = 2.0 if primal > mu * dual else 0.5 if dual > mu * primal else 1.0
        alpha, b = factor * alpha, b / factor if rescale else b
    return np.array(trace)


starts = (0.1, 1.0, 10.0, 100.0)
by_rule = {
    (mu, rescale): [adaptive(alpha, mu, rescale) for alpha in starts]
    for mu in (10.0, 2.0)
    for rescale in (True, False)
}

# %% [markdown]
# The table has the iterations until both residuals are below $10^{-4}$, of at most 1000, and in
# brackets how often $\alpha$ changed.


# %%
def changes(trace):
    return np.count_nonzero(np.diff(trace[:, 0]))


print(f"{'alpha starts at':25}", *(f"{alpha:10g}" for alpha in starts))
print(f"{'alpha fixed':25}", *(f"{len(residuals(alpha, 1)):10}" for alpha in starts))
for (mu, rescale), traces in by_rule.items():
    name = f"mu = {mu:g}, b {'rescaled' if rescale else 'not rescaled'}"
    print(f"{name:25}", *(f"{f'{len(trace)} ({changes(trace)})':>10}" for trace in traces))

# %% [markdown]
# What the forgotten line does depends on $\mu$.
#
# * With Boyd's $\mu = 10$, which `BoydPenalty` uses, the rule needs 104 to 148 iterations from
#   every initial $\alpha$, where a fixed one may need thousands. Without the rescaling it needs 81
#   to 148, so the mistake does not show: $\alpha$ changes at most six times, the last time in
#   iteration 41 or before, and from then on the iteration with a constant $\alpha$ converges from
#   whatever $b$ it has.
# * With $\mu = 2$ the rule follows the residuals closely. With the rescaling this pays: 71 to 79
#   iterations. Without it **no run ends within 1,000 iterations**: every change of $\alpha$ changes
#   the multiplier $\lambda = -\alpha b$, which changes the residuals, which change $\alpha$ again.
#
# So a run that converges does not prove that the update is right. The picture shows the runs from
# $\alpha = 100$: those with $\mu = 2$ are dotted, those without the rescaling are red, and the grey
# line is the tolerance.

# %%
draw_adaptive({rule: traces[-1] for rule, traces in by_rule.items()}, shown=160)

# %% [markdown]
# The library has this rule, with $\mu = 10$, as `BoydPenalty`, for SOC as in the paper. Its dual
# residual has the unit of the weights, so its result depends on that unit. `BalancedPenalty`
# compares relative residuals instead, without the factor $\rho$, as OSQP does, and changes $\rho$
# by a factor of five, but only when they differ by a factor of 25, because every new $\rho$ costs a
# factorisation. (A safeguard raises a fixed $\rho$ that is too small for SOC to converge, as 1 is
# here: [notebook 4](04_splitting_orthogonality.ipynb).)

# %%
problem = pgo.PGOProblem(pgo.load("grid"))
for start in (1.0, 10.0, 100.0, 1000.0):
    fixed = solvers.run(
        solvers.SOC(penalty=solvers.FixedPenalty(start), acceleration=None), problem
    )
    balanced = solvers.BalancedPenalty(
        scale=start / problem.M.diagonal()[problem.num_poses :].mean()
    )
    adapted = solvers.run(solvers.SOC(penalty=balanced, acceleration=None), problem)
    print(
        f"rho = {start:6.0f}   fixed: {fixed.status.name} after {fixed.iterations}   adaptive: {adapted.iterations}"
    )

# %% [markdown]
# ## Where it fails
#
# With two blocks and convex terms ADMM converges for every $\alpha > 0$. **With three it need
# not**, however simple the problem. Chen, He, Ye and Yuan (2016) take $J = 0$ and
# $\mathcal{K} x = 0$, where $\mathcal{K}$ is an invertible 3 by 3 matrix, so that the answer is
# zero. With one pass over $x_1, x_2, x_3$ and the multiplier, the iterates spiral outwards.

# %%
K = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 2.0], [1.0, 2.0, 2.0]])


def block_path(blocks, passes=1, iterations=400):
    """Iterates x and b, one after the other in a row; a block is a list of columns of K."""
    x, b = np.ones(3), np.zeros(3)
    path = [np.concatenate([x, b])]
    for _ in range(iterations):
        for _ in range(passes):
            for block in blocks:
                others = K @ x - K[:, block] @ x[block]
                x[block] = -np.linalg.lstsq(K[:, block], others + b)[0]
        b = b + K @ x
        path.append(np.concatenate([x, b]))
    return np.array(path)


one_by_one = [[0], [1], [2]]
spiral = {T: np.linalg.norm(block_path(one_by_one, T)[-1, :3]) for T in (1, 2, 3, 5, 10)}
for T, size in spiral.items():
    print(f"T = {T:2}   ||x|| after 400 iterations {size:.1e}")
two_blocks = block_path([[0], [1, 2]])
print(f"two blocks   ||x|| after 400 iterations {np.linalg.norm(two_blocks[-1, :3]):.1e}")

# %% [markdown]
# The film has two runs with $T = 1$, side by side in one plane: across is the first unknown,
# upwards its multiplier. Both start at $x = (1, 1, 1)$, $b = 0$. The red one minimises over the
# three unknowns one by one. The blue one minimises over $x_1$ and then over $(x_2, x_3)$ together,
# which makes two blocks of the same problem.

# %%
spiral_film(block_path(one_by_one)[:81, [0, 3]], two_blocks[:81, [0, 3]], every=4)

# %% [markdown]
# Here $T$ decides: with enough passes the iteration is the method of multipliers, which converges.
# SOC has two blocks, $R$ and $\omega$, so this failure does not affect it. But the set of $\omega$
# is not convex, which can affect it ([notebook 4](04_splitting_orthogonality.ipynb)).

# %% [markdown]
# ## Exercises
#
# **1.** The signal is measured in millivolts in place of volts: $f$ and $w$ are 1000 times as
# large. Which $\alpha$ gives the same run?
#
# <details><summary>Answer</summary>
#
# The same $\alpha$: it weighs $D u$ against $u$, and both are in millivolts now. All iterates are
# multiplied by 1000. Where the penalty has a unit, as $\rho$ in SOC has the unit of the weights, it
# must change with the unit.
#
# ```python
# millivolts = total_variation_denoising(1000 * noisy, 1000 * weight)
# state = next(itertools.islice(solvers.iterate(solvers.AlternatingBregman(alpha=1.0), millivolts), 10, None))
# u, d, *_ = list(alternate(1.0, 1, 10))[-1]
# assert np.allclose(state.x, 1000 * np.concatenate([u, d]), atol=0.1)
# ```
#
# </details>
#
# **2.** *Over-relaxation*: in the updates of $d$ and of $b$, replace $D u$ by
# $\beta D u + (1 - \beta) d$. How many iterations does $\beta = 1.6$ save at $\alpha = 1$?
#
# <details><summary>Answer</summary>
#
# About a third of the iterations, without additional work. The library's `over_relaxation` and
# `alpha` of its methods are this $\beta$.
#
# ```python
# def relaxed(alpha, beta):
#     d, b = np.zeros(99), np.zeros(99)
#     inverse = np.linalg.inv(np.eye(100) + alpha * D.T @ D)
#     for k in range(1, 3000):
#         d_before, u = d, inverse @ (noisy + alpha * D.T @ (d - b))
#         moved = beta * D @ u + (1 - beta) * d
#         v = moved + b
#         d = np.sign(v) * np.maximum(np.abs(v) - weight / alpha, 0.0)
#         b = v - d
#         if max(np.linalg.norm(D @ u - d), alpha * np.linalg.norm(D.T @ (d - d_before))) < 1e-4:
#             return k
#
# assert relaxed(1.0, 1.6) < 0.8 * relaxed(1.0, 1.0)
# ```
#
# </details>
#
# **3.** The pass over three blocks is a linear map of $(x, b)$. Which property of this map decides
# between divergence and convergence?
#
# <details><summary>Answer</summary>
#
# Its spectral radius: if it is above 1, the iterates spiral outwards.
#
# ```python
# def one_pass(x, b):
#     for i in range(3):
#         x[i] = -K[:, i] @ (K @ x - K[:, i] * x[i] + b) / (K[:, i] @ K[:, i])
#     return np.concatenate([x, b + K @ x])
#
# matrix = np.column_stack([one_pass(column[:3].copy(), column[3:].copy()) for column in np.eye(6)])
# assert 1.0 < np.abs(np.linalg.eigvals(matrix)).max() < 1.1
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
    assert all(difference < 1e-5 for difference in worst_difference.values())
    assert np.nanmin(counts[0]) < 100
    assert np.ptp(counts[:, penalties.index(1.0)]) <= 2  # small penalty: T does not matter
    save = counts[0, -2] / counts[2, -2]
    assert 4.0 < save < 6.0  # large penalty: T = 5 saves a factor of about 5 outer iterations
    most = {rule: max(map(len, traces)) for rule, traces in by_rule.items()}
    assert most[10.0, True] < 160
    assert most[10.0, False] < 160
    assert most[2.0, True] < 90
    assert min(map(len, by_rule[2.0, False])) == 1000
    assert min(map(len, by_rule[10.0, False])) >= 81
    assert np.linalg.norm(two_blocks[-1, :3]) < 1e-4
    assert spiral[1] > 1e3
    assert spiral[10] < 1e-6
