# %% [markdown]
# # 1. How far from the best possible is an answer?
#
# Open with `jupyter lab notebooks/01_quickstart.ipynb`; `pip install -e '.[notebooks,fast]'` brings it.
#
# A robot measures how it moved between poses, and recognises places it has seen. Every measurement is a little
# wrong, and together they contradict each other. *Pose graph optimisation* looks for the poses that contradict
# them least. Many methods give an answer; this notebook is about knowing how good the answer is.

# %%
import numpy as np

import pgo_models as pgo
import solvers
from pgo_models.plots.graph_plots import plot_against_truth

# %% [markdown]
# ## A graph and its picture
#
# `sphere` is one of the three networks of the paper's section *Simulation results*: 50 poses on a sphere, 544
# relative measurements with noise of 0.5 m and 30 degrees. It came with an estimate of each pose (GPS and an
# IMU, as noisy as the measurements), and since it is a simulation we also know the truth.

# %%
graph = pgo.load("sphere")
problem = pgo.PGOProblem(graph)
graph

# %%
pgo.compare_poses(graph, [("truth", graph.truth), ("GPS and IMU", graph.initial)])

# %% [markdown]
# ## The cost
#
# An edge $(i, j)$ measures $R_{ij} \approx R_i^\top R_j$ and $t_{ij} \approx R_i^\top (t_j - t_i)$. The cost of
# poses is what the paper's equation (16), `min overall` says, each edge with its weights $\kappa_{ij}, \tau_{ij}$:
#
# $$F(R, t) = \sum_{(i,j)} \kappa_{ij} \lVert R_j - R_i R_{ij} \rVert_F^2
#   + \tau_{ij} \lVert t_j - t_i - R_i t_{ij} \rVert_2^2, \qquad R_i \in \mathrm{SO}(d).$$
#
# It is quadratic in $(R, t)$; what makes it hard is only that $R_i$ must be rotations. The weights should be
# precisions: for this noise $\tau = 1 / \sigma_t^2 = 4$ and, in space,
# $\kappa = 1 / (2 \sigma_R^2) = 1.8$. In this scene they are 0.5 and 0.5236, which are the *standard deviations*
# (in metres and radians) themselves: so its source has it (Cristofalo et al. 2020), and so we keep it. Here is
# $F$ by hand.


# %%
def cost(graph, poses):
    total = 0.0
    for e in range(graph.num_edges):
        i, j = graph.i[e], graph.j[e]
        R_error = poses.R[j] - poses.R[i] @ graph.R_ij[e]
        t_error = poses.t[j] - poses.t[i] - poses.R[i] @ graph.t_ij[e]
        total += graph.kappa[e] * np.sum(R_error**2) + graph.tau[e] * np.sum(t_error**2)
    return total


for name, poses in (("GPS and IMU", graph.initial), ("truth", graph.truth)):
    print(f"{name:12} F = {cost(graph, poses):9.3f} by hand, {problem.objective(poses):9.3f} by the library")

# %% [markdown]
# ## Solve
#
# `solve` finds a start, runs SOC (the paper's method, [notebook 4](04_splitting_orthogonality.ipynb)), lets
# Newton finish, and then certifies what it found.

# %%
solution = solvers.solve(problem)
solution

# %%
plot_against_truth(graph, solution.poses)

# %% [markdown]
# Surprising at first: the solution costs *less* than the truth. The truth does not fit the noise; the optimum
# does, as far as 50 poses can. So "F is as low as at the truth" proves nothing. What does?
#
# ## The certificate
#
# A *lower bound* $b$ with $b \le F(R, t)$ for **all** rotations and translations. Then
#
# $$\text{gap} = \frac{F(\text{answer}) - b}{F(\text{answer})}$$
#
# is the most, as a share of $F$, that any other answer could save; neither the units nor the number of
# measurements change it. Where does $b$ come from? Stack all $t_i$ and the rows of all $R_i^\top$ in a matrix
# $X$, so that $F = \operatorname{tr}(X^\top M X)$. For any symmetric matrices $\Lambda_i$, as
# $R_i R_i^\top = I$,
#
# $$F(X) = \operatorname{tr}(X^\top S X) + \sum_i \operatorname{tr} \Lambda_i, \qquad
#   S = M - \operatorname{blockdiag}(0, \Lambda).$$
#
# Were $S$ positive definite, we could minimise the right side over all $X$ whatsoever. It cannot be: turning or
# shifting all poses together changes nothing. So **ground one pose** $r$. Turn and shift the answer, call it
# $\hat X$, so that pose $r$ is $(0, I)$; let $G = S \hat X$, and let $S_r$ and $G_r$ be $S$ and $G$ without the
# rows of pose $r$. If $S_r$ is positive definite, then for **all** poses $X$
#
# $$F(X) \ge b = F(\hat X) - \operatorname{tr}(G_r^\top S_r^{-1} G_r).$$
#
# The proof has three lines:
#
# * Turn and shift $X$ too until its pose $r$ is $(0, I)$; $F(X)$ stays. So $Z = X - \hat X$ is zero at pose $r$.
# * $F(X) - F(\hat X) = 2 \operatorname{tr}(G^\top Z) + \operatorname{tr}(Z^\top S Z)
#   = 2 \operatorname{tr}(G_r^\top Z_r) + \operatorname{tr}(Z_r^\top S_r Z_r)$.
# * Over *all* matrices $Z_r$ that is smallest at $Z_r = -S_r^{-1} G_r$, where it is
#   $-\operatorname{tr}(G_r^\top S_r^{-1} G_r)$.
#
# Cholesky's factorisation exists exactly for positive definite matrices: **that it goes through is the proof.**
# A good choice of $\Lambda$ are the multipliers of the constraints at the answer, $\operatorname{sym}((M X)_i R_i)$;
# with them $G = 0$ at an optimum, and $b$ is $F$ itself.


# %%
def loss_by_hand(problem, poses):
    n, d = problem.num_poses, problem.d
    X = poses.with_gauge_at(0).stacked()  # r = 0
    R = X[n:].reshape(n, d, d).swapaxes(1, 2)
    MX_R = (problem.M @ X)[n:].reshape(n, d, d) @ R
    Lambda = (MX_R + MX_R.swapaxes(1, 2)) / 2
    S = problem.M.toarray()
    for i in range(n):
        rows = slice(n + d * i, n + d * i + d)
        S[rows, rows] -= Lambda[i]
    kept = np.r_[1:n, n + d : n + d * n]  # all rows but those of pose 0
    factor = np.linalg.cholesky(S[np.ix_(kept, kept)])  # raises LinAlgError where there is none
    half = np.linalg.solve(factor, (S @ X)[kept])  # tr(G^T S^-1 G) is the sum of its squares
    return np.sum(half**2)


n, d = problem.num_poses, problem.d
turned = solution.poses.R @ pgo.exp_map(np.random.default_rng(0).normal(0.0, 1e-3, (n, 3)))
nearby = problem.with_best_translations(turned)  # every pose turned by about 0.1 degrees
rows = {}
for name, poses in (("the solution", solution.poses), ("0.1 degrees off", nearby)):
    objective, by_library = problem.objective(poses), pgo.certify_at(problem, poses).lower_bound
    rows[name] = (objective, objective - loss_by_hand(problem, poses), by_library)
    print("{:16} F {:.10f}   b {:.10f} by hand, {:.10f} by the library".format(name, *rows[name]))

# %% [markdown]
# Even poses that are a little off give a bound that is nearly sharp: both $F$ and $b$ are off by the *square* of
# the error. (Then $b$ depends a little on which pose is grounded; the library takes one in the middle.)
#
# By hand, the numbers come from a computer that rounds, and the proof is for exact ones. The library bounds
# every rounding error, in the entries of $S_r$, its factorisation, $G$ and $F$, and subtracts them all: its
# bound is a little smaller, and holds *in exact arithmetic* for the measurements as they are stored.

# %%
certificate = solution.certificate
print(f"F - b {solution.objective - solution.lower_bound:.1e}, about tr(G^T S^-1 G)", end=" ")
print(f"{loss_by_hand(problem, solution.poses):.1e} and, for rounding, {certificate.bound.rounding:.1e}")
print(f"gap   {solution.gap:.1e}: {certificate.digits} digits of F are proven")

# %% [markdown]
# So nobody will ever find poses for these measurements with $F$ below that bound. `certify` does the same for
# *anybody's* poses (it first looks for the optimum beside them). Here for the truth: 7.6 % of its $F$ could be
# saved.

# %%
pgo.certify(problem, graph.truth)

# %% [markdown]
# ## Where a method fails and the certificate says so
#
# Thirty poses on a ring, each 12 degrees further round; every measurement nearly exact. Start a descent method
# at random poses: it may stop where the chain of poses winds round once too often. There the gradient is zero
# and every small change makes $F$ larger; nothing that is *local* can tell.

# %%
rng = np.random.default_rng(0)
count = 30
turn = pgo.exp_map(2 * np.pi / count + 0.05 * rng.standard_normal((count, 1)))
ring = pgo.PoseGraph(
    num_poses=count,
    i=np.arange(count),
    j=(np.arange(count) + 1) % count,
    R_ij=turn,
    t_ij=np.array([1.0, 0.0]) + 0.05 * rng.standard_normal((count, 2)),
    kappa=np.full(count, 100.0),
    tau=np.full(count, 100.0),
    name="ring",
)
ring_problem = pgo.PGOProblem(ring)


def random_start(seed):
    rng = np.random.default_rng(seed)
    return pgo.Poses(pgo.random_rotations(count, 2, rng), rng.normal(0.0, 3.0, (count, 2)))


descents = [pgo.polish(ring_problem, random_start(seed)) for seed in range(8)]
certificates = [pgo.certify(ring_problem, poses) for poses in descents]
for seed, (poses, certificate) in enumerate(zip(descents, certificates, strict=True)):
    gradient = np.concatenate([part.ravel() for part in ring_problem.riemannian_gradient(poses)])
    print(f"start {seed}: gradient {np.abs(gradient).max():.0e}, {certificate!r}")

# %%
worst = max(certificates, key=lambda certificate: certificate.objective)
stuck, best = descents[certificates.index(worst)], solvers.solve(ring)
pgo.compare_poses(
    ring, [(f"stuck, F = {worst.objective:.4g}", stuck), (f"optimal, F = {best.objective:.4g}", best.poses)]
)

# %% [markdown]
# The gap of such an answer is nearly 1: almost all of its cost could be saved. A gap is not always a verdict on
# the answer, though. If the noise is very strong, $S_r$ is not positive definite even at the optimum. The library
# then adds a shift $\eta$ to make it so, pays for that, and an optimal answer keeps a gap: [notebook
# 5](05_sdp_and_certificates.ipynb) looks for the noise at which that begins.

# %% [markdown]
# ## Exercises
#
# **1.** All weights are multiplied by 100. What becomes of $F$, of the bound, of the gap?
#
# <details><summary>Answer</summary>
#
# $F$, $M$, $\Lambda$ and the bound are multiplied by 100; the gap, a share, stays.
#
# ```python
# heavy = solvers.solve(graph.with_weights(100 * graph.kappa, 100 * graph.tau))
# assert np.isclose(heavy.objective, 100 * solution.objective, rtol=1e-9)
# assert heavy.certificate.digits >= 11
# ```
#
# </details>
#
# **2.** The proof takes *any* $\Lambda$. What does $\Lambda = 0$ prove?
#
# <details><summary>Answer</summary>
#
# $S = M$, and the bound is the minimum of $\operatorname{tr}(X^\top M X)$ over all matrices with pose $r$ held at
# $(0, I)$: least squares without the constraints. It holds, and it is a poor one.
#
# ```python
# without_multipliers = pgo.prove_bound(problem, np.zeros((n, d, d)), poses=solution.poses)
# assert 0 < without_multipliers < 0.9 * solution.lower_bound
# ```
#
# </details>
#
# **3.** How often does the worst of the eight rings wind round? Add up its angles.
#
# <details><summary>Answer</summary>
#
# Twice or more, or the wrong way: any number but once. Changing it means tearing the chain open, so that no small
# move does.
#
# ```python
# angles = pgo.log_map(np.swapaxes(stuck.R, 1, 2) @ np.roll(stuck.R, -1, axis=0))[:, 0]
# winding = np.sum(angles) / (2 * np.pi)
# assert np.isclose(winding, round(winding))
# assert round(winding) != 1
# ```
#
# </details>

# %%
assert np.isclose(cost(graph, graph.truth), problem.objective(graph.truth))
assert solution.is_certified
assert certificate.eta == 0
assert certificate.digits >= 11
objective, by_hand, _ = rows["the solution"]
assert np.isclose(by_hand, solution.lower_bound, rtol=1e-11, atol=0)
objective, by_hand, by_library = rows["0.1 degrees off"]
assert np.isclose(by_hand, by_library, rtol=1e-7, atol=0)
assert max(by_hand, by_library) < solution.objective < objective
rng = np.random.default_rng(1)
for _ in range(100):
    anything = pgo.Poses(pgo.random_rotations(n, d, rng), rng.normal(0.0, 3.0, (n, d)))
    assert problem.objective(anything) >= solution.lower_bound
assert solution.lower_bound <= solution.objective < problem.objective(graph.truth)
assert worst.gap > 0.9
for _ in range(100):  # a local minimum: nearby poses cost more
    nearby = stuck.R @ pgo.exp_map(rng.normal(0.0, 0.01, (count, 1)))
    assert ring_problem.objective(ring_problem.with_best_translations(nearby)) > worst.objective
assert any(certificate.is_certified for certificate in certificates)
