# %% [markdown]
# # 11. ADMM across machines: how do machines agree on an answer when none shows its data?
#
# Open with `jupyter lab notebooks/11_admm_across_machines.ipynb`;
# `pip install -e '.[notebooks,fast]'` installs it.
#
# - **Prerequisites:** [notebook 3](03_bregman_is_admm.ipynb), where ADMM is Bregman iteration with
#   one pass over the blocks of unknowns; for the last section also
#   [notebook 6](06_robots_and_messages.ipynb), where robots exchange messages.
# - **Time:** 30 minutes
# - **Next:** [notebook 12](12_bregman_on_a_picture.ipynb), what Bregman iteration does to a picture
#
# The paper's section *Equivalence to ADMM* ends where ADMM becomes useful for robots. With one pass
# (the paper's $T = 1$ in equation (9)) the blocks of $x$ are minimised one by one, and blocks that
# share no term can be minimised *at the same time*, on different machines. Boyd et al. (*Distributed
# optimization and statistical learning via ADMM*, 2011, chapter 7) describe three patterns for this.
# This notebook codes them for machines that are not robots, and then runs the same code, line for
# line, for two robots.
#
# What only draws is in [`drawings/admm_across_machines.py`](drawings/admm_across_machines.py).

# %%
import itertools

import cvxpy as cp
import matplotlib.pyplot as plt
import numpy as np
from drawings.admm_across_machines import draw_distances_and_prices, film_of_plans
from drawings.checks import NamedNumbers

import pgo_models as pgo
import solvers
from pgo_models.convex.prox import soft_threshold

plt.rcParams["figure.dpi"] = 110
rng = np.random.default_rng(0)
accurate = {"solver": cp.CLARABEL, "tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-12}


# %% [markdown]
# ## Consensus: one model, data in five places
#
# Five hospitals have measured different patients. Together they want the sparse model that fits all
# data,
#
# $$\min_x \sum_a \tfrac12 \lVert A_a x - b_a \rVert^2 + w \lVert x \rVert_1 .$$
#
# Give each hospital its own $x_a$, and one $z$ to which all must be equal: $x_a - z = 0$ is the
# constraint $\mathcal{K} x = f$ of equation (1). Minimise over all $x_a$ (they share no term), then
# over $z$, then add the residual back:
#
# $$\begin{aligned}
#   x_a &= \arg\min_x f_a(x) + \tfrac\rho2 \lVert x - z + u_a \rVert^2 && \text{each machine alone} \\
#   z &= \operatorname{prox}\bigl(\text{mean of } x_a + u_a\bigr) && \text{known to all} \\
#   u_a &\leftarrow u_a + x_a - z && \text{each machine alone}
# \end{aligned}$$
#
# A machine need not hold all of $z$ (Boyd's *general form*, section 7.2): `held[a]` lists the rows of
# which it has copies.


# %%
def consensus(solve, held, prox, z, u):
    """Yields z after every round; solve[a](v) minimises f_a plus the penalty to v."""
    copies = np.bincount(np.concatenate(held), minlength=len(z)).astype(float)
    while True:
        x = [solve[a](z[held[a]] - u[a]) for a in range(len(held))]
        total = np.zeros_like(z)
        for a, rows in enumerate(held):
            total[rows] += x[a] + u[a]
        z = prox((total.T / copies).T)
        u = [u[a] + x[a] - z[rows] for a, rows in enumerate(held)]
        yield z


# %% [markdown]
# The five hospitals have 60 patients each, and the model has 40 coefficients, few of which are not
# zero. The step of one hospital is a ridge regression towards $z - u_a$.


# %%
def ridge(A, b, rho):
    inverse = np.linalg.inv(A.T @ A + rho * np.eye(A.shape[1]))
    return lambda v: inverse @ (A.T @ b + rho * v)


machines, size, sparsity, rho = 5, 40, 25.0, 20.0  # sparsity is w
model = np.where(rng.random(size) < 0.15, rng.normal(0.0, 2.0, size), 0.0)
A = [rng.standard_normal((60, size)) for _ in range(machines)]
b = [A_a @ model + 0.5 * rng.standard_normal(60) for A_a in A]

everything = [np.arange(size)] * machines
local = [ridge(A_a, b_a, rho) for A_a, b_a in zip(A, b, strict=True)]
rounds = consensus(
    local,
    everything,
    lambda v: soft_threshold(v, sparsity / (rho * machines)),
    np.zeros(size),
    [np.zeros(size)] * machines,
)
by_hand = list(itertools.islice(rounds, 60))

# %% [markdown]
# A machine that had the data of all five would solve the problem at once. That is the answer to
# compare with.

# %%
x = cp.Variable(size)
loss = 0.5 * cp.sum_squares(np.vstack(A) @ x - np.concatenate(b))
cp.Problem(cp.Minimize(loss + sparsity * cp.norm1(x))).solve(**accurate)
distance = [np.linalg.norm(z - x.value) for z in by_hand]
print(
    "distance to the model from pooled data, after 10, 30, 60 rounds:",
    *(f"{distance[k]:.0e}" for k in (9, 29, 59)),
)
print(
    f"nonzeros: {np.count_nonzero(by_hand[-1])} of {size}, the truth has {np.count_nonzero(model)}"
)

# %% [markdown]
# ## The library agrees
#
# `AlternatingBregman` with one pass is equation (9) with $T = 1$, over the blocks that the problem
# names: five $x_a$ and $z$. Its matrix $\mathcal{K}$ takes $z$ from every $x_a$.

# %%
blocks = [cp.Variable(size, name=f"x_{a}") for a in range(machines)]
z = cp.Variable(size, name="z")
losses = [0.5 * cp.sum_squares(A_a @ x_a - b_a) for A_a, x_a, b_a in zip(A, blocks, b, strict=True)]
K = np.hstack([np.eye(machines * size), -np.tile(np.eye(size), (machines, 1))])
lasso = pgo.BregmanProblem(
    sum(losses, sparsity * cp.norm1(z)), [*blocks, z], K, np.zeros(machines * size)
)
states = itertools.islice(
    solvers.iterate(solvers.AlternatingBregman(alpha=rho, passes=1), lasso), 1, 11
)
difference = max(
    np.abs(state.x[-size:] - mine).max() for state, mine in zip(states, by_hand, strict=False)
)
print(f"differs from ours by {difference:.0e} in 10 rounds")

# %% [markdown]
# ## Sharing: many plans, one total
#
# Twelve power stations plan 24 hours. Each has its own cost and its own limits, and a common cost
# depends on the distance of the *sum* from the demand,
#
# $$\min \sum_a f_a(x_a) + g\Bigl(\sum_a x_a\Bigr), \qquad
#   f_a(x) = \tfrac{q_a}2 \lVert x \rVert^2 \text{ on } [0, c_a], \quad
#   g(s) = \tfrac w2 \lVert s - \text{demand} \rVert^2 .$$
#
# No station needs to see the plan of another one, only the *mean* (section 7.3): with $\bar x$ the
# mean of the plans and $\bar z$ its target value,
#
# $$\begin{aligned}
#   x_a &\leftarrow \operatorname{prox}_{f_a / \rho}\bigl(x_a + \bar z - \bar x - u\bigr) \\
#   \bar z &\leftarrow \arg\min_{\bar z} g(N \bar z) + \tfrac{N \rho}2 \lVert \bar z - u - \bar x \rVert^2 \\
#   u &\leftarrow u + \bar x - \bar z
# \end{aligned}$$

# %%
stations, hours, w = 12, 24, 4.0
q, cap = rng.uniform(0.5, 3.0, (stations, 1)), rng.uniform(0.5, 2.0, (stations, 1))
demand = (
    8.0 + 3.0 * np.sin(2 * np.pi * (np.arange(hours) - 8) / 24) + 0.5 * rng.standard_normal(hours)
)


def sharing(rounds, rho=1.0):
    plans = np.zeros((stations, hours))
    mean = u = np.zeros(hours)
    for _ in range(rounds):
        v = plans + mean - plans.mean(axis=0) - u
        plans = np.clip(rho * v / (q + rho), 0.0, cap)  # each station alone
        average = plans.mean(axis=0)  # all that crosses
        mean = (w * demand + rho * (u + average)) / (stations * w + rho)
        u = u + average - mean
        yield plans


every_plan = list(sharing(200))

# %% [markdown]
# The central plan is that of one machine which knows the costs and limits of all stations.

# %%
X = cp.Variable((stations, hours))
cost = cp.sum(cp.multiply(q / 2, cp.square(X))) + w / 2 * cp.sum_squares(cp.sum(X, axis=0) - demand)
limits = [X >= 0, cp.multiply(np.ones((1, hours)), X) <= np.tile(cap, (1, hours))]
cp.Problem(cp.Minimize(cost), limits).solve(**accurate)
shared_distance = [np.abs(plans - X.value).max() for plans in every_plan]
print("largest difference from the central plan, after 20, 60, 200 rounds:", end=" ")
print(*(f"{shared_distance[k]:.0e}" for k in (19, 59, 199)))
film_of_plans([np.zeros((stations, hours)), *every_plan[:20]], demand, X.value)

# %% [markdown]
# Each layer is the plan of a station. In round 1 all plans are still zero, because the stations know
# of no target yet. Then they grow together, and after 20 rounds no plan differs from the central one
# by more than 8e-04. The lowest layer is flat during the day: that station is at its limit, and the
# others produce more. The sum stays a little below the demand, because power has its cost, too.
#
# ## Exchange: a price that nobody sets
#
# In a special case, $g$ requires that the sum *is* zero. Buyers want $x_a > 0$ and sellers
# $x_a < 0$. Each knows only its own cost,
# $f_a(x) = \tfrac{q_a}2 \lVert x - \text{wish}_a \rVert^2$. Then $\bar z = 0$ and two lines remain,
#
# $$x_a \leftarrow \operatorname{prox}_{f_a / \rho}(x_a - \bar x - u), \qquad u \leftarrow u + \bar x .$$
#
# $\rho u$ increases where demand exceeds supply, and decreases where supply exceeds demand: it is
# the price, and its limit is the multiplier of $\sum_a x_a = 0$.

# %%
traders, goods = 20, 3
q_a, wish = rng.uniform(0.5, 2.0, (traders, 1)), rng.normal(0.5, 2.0, (traders, goods))


def exchange(rounds, rho=0.5, share=1.0):
    """`share` is how much of the mean excess each trader takes back."""
    trades, u, prices = np.zeros((traders, goods)), np.zeros(goods), []
    for _ in range(rounds):
        v = trades - share * trades.mean(axis=0) - u
        trades = (q_a * wish + rho * v) / (q_a + rho)
        u = u + share * trades.mean(axis=0)
        prices.append(rho * u)
    return trades, np.array(prices)


trades, prices = exchange(60)

# %%
T = cp.Variable((traders, goods))
balance = cp.sum(T, axis=0) == 0
cost = cp.sum(cp.multiply(q_a / 2, cp.square(T - wish)))
cp.Problem(cp.Minimize(cost), [balance]).solve(solver=cp.CLARABEL)
distances = {
    "consensus": distance,
    "sharing": shared_distance[:60],
    "exchange (price)": np.abs(prices - balance.dual_value).max(axis=1),
}
draw_distances_and_prices(distances, prices, balance.dual_value)

# %% [markdown]
# ## The bridge: two robots
#
# Now the machines are robots and $z$ is poses. The cost $f_a$ contains the edges that robot $a$
# knows, with half of those that it shares with the other robot. The robot holds its own poses and
# copies of the other's separators, the poses with an edge to another robot (`held`). Instead of the
# soft threshold, $z$ is projected to rotations, which is the constraint of equation (18), on the
# consensus variable. The rest is the function `consensus` from above, unchanged. In the library this
# is the coupling `CONSENSUS`.
#
# Who holds what: all unknowns are stacked in $z$, the positions $t_i$ first and then the rows of
# every $R_i^T$.

# %%
graph = pgo.load("grid")
problem = pgo.PGOProblem(graph)
n, d = problem.num_poses, problem.d
robots = pgo.partition(graph, 2, pgo.PartitionMethod.CONTIGUOUS)
owner = robots.robot
knows = [(owner[graph.i] == a) | (owner[graph.j] == a) for a in range(2)]  # edges
poses = [np.unique(np.concatenate([graph.i[edges], graph.j[edges]])) for edges in knows]
held = [np.concatenate([p, (n + d * p[:, None] + np.arange(d)).ravel()]) for p in poses]
is_shared = np.bincount(np.concatenate(poses), minlength=n) > 1
print(f"{n} poses, {np.count_nonzero(is_shared)} of which both robots hold")

# %% [markdown]
# The penalty is $\rho$ for rotations, and a tenth of the diagonal of $M$ for the positions that both
# hold; two copies of a pose have half of it each. A robot's step minimises its quadratic cost $f_a$
# plus the penalty to $v = z - u_a$, as the hospitals' ridge regression did.

# %%
pose_rho, relative_rho_t = 12.0, 0.1
copies = np.concatenate([1.0 + is_shared, np.repeat(1.0 + is_shared, d)])  # of every row of z
position_rho = relative_rho_t * problem.M.diagonal()[:n] * is_shared
penalty = np.concatenate([position_rho, np.full(n * d, pose_rho)]) / copies
residuals, weights = problem.residual_matrix


def quadratic(a):
    """M_a, with f_a(x) = tr(x^T M_a x)."""
    share = np.where(robots.cut_edges(graph), 0.5, 1.0) * knows[a]
    scaled = residuals * (weights * np.concatenate([share, np.repeat(share, d)]))[:, None]
    return (residuals.T @ scaled).toarray()[np.ix_(held[a], held[a])]


def robot_step(a):
    D = penalty[held[a]][:, None]
    inverse = np.linalg.inv(quadratic(a) + np.diagflat(D) / 2)
    return lambda v: inverse @ (D / 2 * v)


def rotations(z):
    R = z[n:].reshape(n, d, d).transpose(0, 2, 1)
    return np.concatenate([z[:n], pgo.project_to_rotations(R).transpose(0, 2, 1).reshape(n * d, d)])


# %% [markdown]
# The start is the chordal one, and every $u_a$ holds the forces on its robot in balance there, but
# for their mean over the copies of a pose, which is subtracted, as in notebook 6.

# %%
start = pgo.chordal_start(problem)
u, mean_u = [], np.zeros((problem.side, d))
for a in range(2):
    force = -2 * quadratic(a) @ start.stacked()[held[a]]
    D = penalty[held[a]][:, None]
    u.append(np.divide(force, D, out=np.zeros_like(force), where=D > 0))
    mean_u[held[a]] += u[a] / copies[held[a]][:, None]
u = [u[a] - mean_u[held[a]] for a in range(2)]
steps = [robot_step(a) for a in range(2)]
ours = list(itertools.islice(consensus(steps, held, rotations, start.stacked(), u), 25))

# %%
soc = solvers.SOC(
    robots=robots,
    penalty=solvers.FixedPenalty(pose_rho),
    translation_penalty=relative_rho_t,
    acceleration=None,
    local_passes=1,
    bytes_per_number=8,
    coupling=solvers.Coupling.CONSENSUS,
)
library = [state.omega for state in itertools.islice(solvers.iterate(soc, problem), 1, 26)]
bridge = max(
    np.abs(z[n:].reshape(n, d, d).transpose(0, 2, 1) - omega).max()
    for z, omega in zip(ours, library, strict=True)
)
best = solvers.solve(problem)
gaps = [
    problem.objective(problem.with_best_translations(omega)) / best.objective - 1
    for omega in library
]
print(f"two robots: differs from the library by {bridge:.0e} in 25 rounds")
print(f"gap {gaps[0]:.0e} after one round, {gaps[-1]:.0e} after 25")

# %% [markdown]
# ## Where it fails
#
# 1. *Everybody corrects the whole error.* In the exchange each trader corrects the *mean* excess.
#    If each corrected the whole excess, twenty traders would correct it twentyfold.
# 2. *Bytes.* Each round of consensus sends two vectors per machine. In this example it would have
#    been cheaper to send the data.
# 3. *Nothing is secret.* From $x_a + u_a$ over the rounds, others can infer much of $A_a$ and
#    $b_a$. Privacy needs more than ADMM.

# %%
with np.errstate(over="ignore", invalid="ignore"):
    _, wild = exchange(60, share=float(traders))
sent, data = (
    60 * machines * 2 * size,
    sum(A_a.size + b_a.size for A_a, b_a in zip(A, b, strict=True)),
)
print(f"everybody corrects the whole excess: price {np.abs(wild[-1]).max():.0e} after 60 rounds")
print(f"numbers sent in 60 rounds: {sent}; the data: {data}")

# %% [markdown]
# ## Exercises
#
# **1.** A sixth hospital has no patients at all, so that its $f_a$ is zero. Does it change the
# answer? Does it change the number of rounds?
#
# <details><summary>Answer</summary>
#
# It does not change the answer, because the sum is the same. But the mean includes its $x_a$, which
# is what it last received, and this slows the others down.
#
# ```python
# with_sixth = consensus(
#     [*local, lambda v: v],
#     [np.arange(size)] * 6,
#     lambda v: soft_threshold(v, sparsity / (rho * 6)),
#     np.zeros(size),
#     [np.zeros(size)] * 6,
# )
# later = [np.linalg.norm(z - x.value) for z in itertools.islice(with_sixth, 60)]
# assert distance[20] < later[20] and later[-1] < 1e-3
# ```
#
# </details>
#
# **2.** What is the price in the exchange when every trader has the same $q$? Derive it and check
# it.
#
# <details><summary>Answer</summary>
#
# At the price $p$ trader $a$ takes $x_a = \text{wish}_a - p / q_a$. The sum is zero for
# $p \sum_a 1 / q_a = \sum_a \text{wish}_a$; with one $q$ the price is $q$ times the mean wish.
#
# ```python
# assert np.allclose(prices[-1], wish.sum(axis=0) / (1 / q_a).sum(), atol=1e-5)
# ```
#
# </details>
#
# **3.** Leave out the projection in the bridge, so that `prox` is the identity. On what do the
# robots then agree?
#
# <details><summary>Answer</summary>
#
# On the minimum of $F$ over all matrices, without orthogonality. It is zero, with all poses at one
# point and all $R_i = 0$. The constraint excludes this solution.
#
# ```python
# loose = itertools.islice(consensus(steps, held, lambda v: v, start.stacked(), u), 400)
# *_, collapsed = loose
# assert np.linalg.norm(collapsed[n:]) < 0.1 * np.linalg.norm(start.stacked()[n:])
# ```
#
# </details>

# %% [markdown]
# ## Checks of the numbers above
#
# They hold for the parameters as they stand. A reader who has changed some may skip this cell.

# %%
with NamedNumbers():
    assert distance[-1] < 1e-4
    assert difference < 1e-6
    assert shared_distance[-1] < 1e-4
    assert np.abs(prices[-1] - balance.dual_value).max() < 1e-4
    assert np.abs(trades - T.value).max() < 1e-4
    assert bridge < 1e-9
    assert gaps[-1] < 1e-3
    assert not np.abs(wild[-1]).max() < 1e6
    assert sent > data
