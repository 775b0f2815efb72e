# %% [markdown]
# # 1. How far from the best possible is an answer?
#
# Open with `jupyter lab notebooks/01_quickstart.ipynb`; `pip install -e '.[notebooks,fast]'`
# installs it.
#
# * **Prerequisites:** matrices, and the rotations among them; for the proof of the bound, what positive
#   definite means
# * **Time:** 20 minutes
# * **Next:** [notebook 2](02_bregman.ipynb), the iteration on which the paper's method is built. To see
#   why a lower bound settles the question, without optimisation, begin with
#   [notebook 14](14_is_it_really_the_best.ipynb)
#
# A robot measures its motion between poses, and it recognises places that it has seen before. Every
# measurement has a small error, so the measurements contradict each other. *Pose graph
# optimisation* finds the poses that contradict them least. Many methods return an answer; this
# notebook shows how to find out how good the answer is.

# %%
import matplotlib.pyplot as plt
import numpy as np
from drawings.checks import NamedNumbers

import pgo_models as pgo
import solvers
from pgo_models.plots.graph_plots import plot_against_truth

# %% [markdown]
# ## A graph and its picture
#
# `sphere` is one of the three networks of the paper's section *Simulation results*: 50 poses on a
# sphere, 544 relative measurements with noise of 0.5 m and 30 degrees. It came with an estimate of
# each pose (GPS and an IMU, as noisy as the measurements), and since it is a simulation we also
# know the truth.

# %%
graph = pgo.load("sphere")
problem = pgo.PGOProblem(graph)
graph

# %%
pgo.compare_poses(graph, [("truth", graph.truth), ("GPS and IMU", graph.initial)])

# %% [markdown]
# ## The cost
#
# An edge $(i, j)$ measures $R_{ij} \approx R_i^\top R_j$ and $t_{ij} \approx R_i^\top (t_j - t_i)$.
# The cost of poses is the paper's equation (16), with weights $\kappa_{ij}, \tau_{ij}$ for each edge:
#
# $$F(R, t) = \sum_{(i,j)} \kappa_{ij} \lVert R_j - R_i R_{ij} \rVert_F^2
#   + \tau_{ij} \lVert t_j - t_i - R_i t_{ij} \rVert_2^2, \qquad R_i \in \mathrm{SO}(d).$$
#
# The cost is quadratic in $(R, t)$; the problem is hard only because the $R_i$ must be rotations.
# The weights should be precisions: for this noise $\tau = 1 / \sigma_t^2 = 4$ and, in space,
# $\kappa = 1 / (2 \sigma_R^2) = 1.8$. In this scene they are 0.5 and 0.5236, which are the
# *standard deviations* (in metres and radians) themselves. We keep these values, because the source
# of the scene uses them (Cristofalo et al. 2020). Here is $F$ by hand.


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
    print(
        f"{name:12} F = {cost(graph, poses):9.3f} by hand, {problem.objective(poses):9.3f} by the library"
    )

# %% [markdown]
# ## Solve
#
# `solve` computes an initial estimate, runs SOC (the paper's method,
# [notebook 4](04_splitting_orthogonality.ipynb)) where it is faster than Newton's method alone,
# ends with Newton's method, and then certifies the result.

# %%
solution = solvers.solve(problem)
solution

# %%
plot_against_truth(graph, solution.poses)

# %% [markdown]
# This may be surprising: the solution costs *less* than the truth. The truth does not fit the
# noise; the optimum does, as far as 50 poses can. So "F is as low as at the truth" proves nothing.
# What does prove that an answer is good?
#
# ## The certificate
#
# The proof is a *lower bound* $b$ with $b \le F(R, t)$ for **all** rotations and translations. Then
#
# $$\text{gap} = \frac{F(\text{answer}) - b}{F(\text{answer})}$$
#
# is the largest share of $F$ that any other answer could save. It depends neither on the units nor
# on the number of measurements. Where does $b$ come from? Stack all $t_i$ and the rows of all
# $R_i^\top$ in a matrix $X$, so that $F = \operatorname{tr}(X^\top M X)$. For any symmetric
# matrices $\Lambda_i$, as $R_i R_i^\top = I$,
#
# $$F(X) = \operatorname{tr}(X^\top S X) + \sum_i \operatorname{tr} \Lambda_i, \qquad
#   S = M - \operatorname{blockdiag}(0, \Lambda).$$
#
# If $S$ were positive definite, we could minimise the right side over all matrices $X$. It cannot
# be positive definite, because rotating and shifting all poses together does not change $F$. So
# **ground one pose** $r$: rotate and shift the answer, call it $\hat X$, so that pose $r$ is
# $(0, I)$. Let $G = S \hat X$, and let $S_r$ and $G_r$ be $S$ and $G$ without the rows of pose $r$.
# If $S_r$ is positive definite, then for **all** poses $X$
#
# $$F(X) \ge b = F(\hat X) - \operatorname{tr}(G_r^\top S_r^{-1} G_r).$$
#
# The proof has three lines:
#
# * Rotate and shift $X$ as well, so that its pose $r$ is $(0, I)$; $F(X)$ does not change. So
#   $Z = X - \hat X$ is zero at pose $r$.
# * $F(X) - F(\hat X) = 2 \operatorname{tr}(G^\top Z) + \operatorname{tr}(Z^\top S Z)
#   = 2 \operatorname{tr}(G_r^\top Z_r) + \operatorname{tr}(Z_r^\top S_r Z_r)$.
# * Over *all* matrices $Z_r$ the minimum is at $Z_r = -S_r^{-1} G_r$, with the value
#   $-\operatorname{tr}(G_r^\top S_r^{-1} G_r)$.
#
# A Cholesky factorisation exists if and only if the matrix is positive definite: **a successful
# factorisation is the proof.** A good choice of $\Lambda$ are the multipliers of the constraints at
# the answer, $\operatorname{sym}((M X)_i R_i)$; with them $G = 0$ at an optimum, and $b$ is $F$
# itself.


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
# Even slightly inaccurate poses give a nearly sharp bound: the errors of both $F$ and $b$ are of
# the order of the *square* of the error of the poses. (In that case $b$ depends slightly on which
# pose is grounded; the library takes one in the middle of the graph.)
#
# The computation above rounds its numbers, but the proof holds for exact numbers. The library
# bounds every rounding error, in the entries of $S_r$, in its factorisation, in $G$ and in $F$, and
# subtracts all of them. Its bound is slightly smaller, and holds *in exact arithmetic* for the
# measurements as they are stored.

# %%
certificate = solution.certificate
print(f"F - b {solution.objective - solution.lower_bound:.1e}, about tr(G^T S^-1 G)", end=" ")
print(
    f"{loss_by_hand(problem, solution.poses):.1e} and, for rounding, {certificate.bound.rounding:.1e}"
)
print(f"gap   {certificate.gap_text}")

# %% [markdown]
# So there are no poses for these measurements with $F$ below this bound. `certify` does the same
# for poses from *any* source (it first computes the optimum near them). For the ground truth it
# finds that 7.6 % of its $F$ could be saved.

# %%
solvers.certify(problem, graph.truth)

# %% [markdown]
# ## Where a method fails and the certificate shows it
#
# Thirty poses lie on a ring, each 12 degrees further along than the one before, and every
# measurement is nearly exact. A descent method that starts at random poses may stop at a chain of
# poses that winds around the ring once too often. The gradient is zero there, and every small
# change increases $F$. No *local* test can detect this.

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


descents = [solvers.polish(ring_problem, random_start(seed)) for seed in range(8)]
certificates = [solvers.certify(ring_problem, poses) for poses in descents]
for seed, (poses, certificate) in enumerate(zip(descents, certificates, strict=True)):
    gradient = np.concatenate([part.ravel() for part in ring_problem.riemannian_gradient(poses)])
    print(f"start {seed}: gradient {np.abs(gradient).max():.0e}, {certificate!r}")

# %%
worst = max(certificates, key=lambda certificate: certificate.objective)
stuck, best = descents[certificates.index(worst)], solvers.solve(ring)
pgo.compare_poses(
    ring,
    [
        (f"stuck, F = {worst.objective:.4g}", stuck),
        (f"optimal, F = {best.objective:.4g}", best.poses),
    ],
)

# %% [markdown]
# `solvers.film` shows a method at work: the graph, how far its cost is above the least one of the
# film, and how far the best bound so far is below it. First a start from which Newton's method finds
# the best poses. The bound is zero until it is near them, and then it meets the cost.

# %%
ends_well = next(seed for seed, item in enumerate(certificates) if item.is_certified)
solvers.film(ring_problem, (solvers.Newton(),), random_start(ends_well))

# %% [markdown]
# Now the start of the worst answer. The method converges as well, with a gradient of zero, but the
# bound stays where it is. (The film knows only its own bounds; those above are better, because
# `certify` also tries other starts.)

# %%
solvers.film(ring_problem, (solvers.Newton(),), random_start(certificates.index(worst)))

# %% [markdown]
# How far an answer can be from the best one is a picture, too: a dot for the cost of every answer,
# and a bar from there down to the bound that was proved for it. Where the bar has no length, the
# answer is the best one.

# %%
figure, axes = plt.subplots(figsize=(7.5, 2.4), layout="constrained")
for seed, certificate in enumerate(certificates):
    ends = [certificate.lower_bound, certificate.objective]
    axes.plot(ends, [seed, seed], color="#D55E00", linewidth=3)
    axes.plot(certificate.objective, seed, "o", color="#0072B2")
axes.set_xscale("log")
axes.set_xlabel("F, and the bound below it")
axes.set_ylabel("start")
axes.invert_yaxis()

# %% [markdown]
# The gap of such an answer is nearly 1: almost all of its cost could be saved. But a large gap does
# not always mean that the answer is bad. If the noise is very strong, $S_r$ is not positive
# definite even at the optimum. The library then adds a shift $\eta$ that makes it positive
# definite. The shift lowers the bound, so that even an optimal answer has a gap.
# [Notebook 5](05_sdp_and_certificates.ipynb) finds the noise level at which this begins.

# %% [markdown]
# ## Exercises
#
# **1.** All weights are multiplied by 100. How do $F$, the bound and the gap change?
#
# <details><summary>Answer</summary>
#
# $F$, $M$, $\Lambda$ and the bound are multiplied by 100. The gap is a ratio and does not change.
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
# $S = M$, and the bound is the minimum of $\operatorname{tr}(X^\top M X)$ over all matrices with
# pose $r$ held at $(0, I)$: least squares without the constraints. The bound is valid, but poor.
#
# ```python
# without_multipliers = pgo.prove_bound(problem, np.zeros((n, d, d)), poses=solution.poses)
# assert 0 < without_multipliers < 0.9 * solution.lower_bound
# ```
#
# </details>
#
# **3.** How often does the chain of the worst of the eight answers wind around the ring? Add up its
# angles.
#
# <details><summary>Answer</summary>
#
# Twice or more, or in the wrong direction: any number except once. To change this number the chain
# would have to be cut open, which no small change of the poses does.
#
# ```python
# angles = pgo.log_map(np.swapaxes(stuck.R, 1, 2) @ np.roll(stuck.R, -1, axis=0))[:, 0]
# winding = np.sum(angles) / (2 * np.pi)
# assert np.isclose(winding, round(winding))
# assert round(winding) != 1
# ```
#
# </details>

# %% [markdown]
# ## Checks of the numbers above
#
# This cell is for the tests of the library; if you have changed parameters, you may skip it.

# %%
with NamedNumbers():
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
