# %% [markdown]
# # 9. Can one wrong edge be found?
#
# Open with `jupyter lab notebooks/09_wrong_edges.ipynb`; `pip install -e '.[notebooks,fast]'`
# installs it.
#
# If one place is taken for another that looks the same, a wrong loop closure enters the graph.
# Least squares treats it like every other measurement. The certificate then proves that no poses
# fit *these measurements* better ([notebook 8](08_your_own_graph.ipynb)), also if the map is wrong.
# To remove the wrong edge, one has to decide edge by edge. This notebook shows how this is done,
# and what is proven afterwards.

# %%
import matplotlib.pyplot as plt
import numpy as np

import pgo_models as pgo
import solvers

plt.rcParams["figure.dpi"] = 110

# %% [markdown]
# ## One wrong edge in a small world
#
# A robot walks 60 steps on a lattice of 1 m, with noise of 0.1 m and 3 degrees, and closes six
# loops. A seventh closure is wrong: it states that pose 42 is at the place of pose 8, which is 4.2
# m away.


# %%
def world(seed, probability, robots=1, steps=60):
    return pgo.grid_world(
        robots, steps, np.random.default_rng(seed), d=2, loop_closure_probability=probability
    )


def is_odometry(graph):
    return (np.abs(graph.i - graph.j) == 1) & (graph.robots[graph.i] == graph.robots[graph.j])


def with_wrong(graph, i, j, measured):
    """The graph with more closures, and which edges they are."""
    spoiled = graph.with_edges(np.asarray(i), np.asarray(j), measured, graph.kappa[0], graph.tau[0])
    return spoiled, np.arange(spoiled.num_edges) >= graph.num_edges


def draw(panels, truth):
    columns = plt.subplots(1, len(panels), figsize=(2.6 * len(panels), 2.6), layout="constrained")[
        1
    ]
    for axes, (title, graph, poses, is_wrong) in zip(columns, panels, strict=True):
        t = poses.aligned_to(truth).t
        for e in range(graph.num_edges):
            colour = "#D55E00" if is_wrong[e] else "#0072B2" if is_odometry(graph)[e] else "#999999"
            axes.plot(
                *t[[graph.i[e], graph.j[e]]].T,
                "o-" if is_wrong[e] else "-",
                color=colour,
                markersize=3,
                lw=1.2,
            )
        axes.set_title(
            f"{title}, {pgo.absolute_trajectory_error(poses, truth):.2f} m off", fontsize=8
        )
        axes.set_aspect("equal")
        axes.tick_params(labelsize=6)


clean = world(24, 0.03)
same_place = pgo.Poses(np.eye(2)[None], np.zeros((1, 2)))
graph, is_wrong = with_wrong(clean, [8], [42], same_place)
truth, wrong = clean.truth, clean.num_edges
without, fooled = solvers.solve(clean), solvers.solve(graph)
draw(
    [("without it", graph, without.poses, is_wrong), ("with it", graph, fooled.poses, is_wrong)],
    truth,
)
print(repr(without), repr(fooled), sep="\n")

# %% [markdown]
# Odometry is blue, closures are grey, and the wrong closure is vermilion (drawn in both maps). In
# the map with the wrong closure it is the short line in the middle, and it is nearly satisfied.
# This map is certified like the other one.
#
# ## Why the worst edge need not be the wrong one
#
# The residuals show that something is wrong: the sum of all costs is far above its threshold. They
# do not show which edge is wrong. To first order, in units of standard deviations, least squares
# turns the errors $e$ into the residuals
#
# $$r = (I - H)\, e, \qquad H = H^\top = H^2, \qquad
#   r_w = (1 - h)\, e_w, \qquad \sum_{k \ne w} r_k^2 = h (1 - h)\, e_w^2,$$
#
# with $H$ the projector on what the poses can fit, and $h = H_{ww}$ the *leverage* of the wrong
# edge $w$. The wrong edge adds the cost $(1 - h) e_w^2$. It carries only the share $1 - h$ of it;
# the rest is distributed over the other edges. Where many closures contradict it, $h$ is small. As
# long as $h < 1/2$, no other edge has a larger residual, since $|H_{wk}| \le \sqrt{h (1 - h)}$ is
# below $1 - h$. Where few closures contradict it, $h$ is close to 1.

# %%
residuals = fooled.edge_residuals
brought_in = fooled.objective - without.objective
own_share = residuals.cost[wrong] / brought_in
print(
    f"all costs together: {residuals.overall:.1f} times what is expected, {residuals.overall_allowed:.2f} may be"
)
print(
    f"the wrong edge brought in {brought_in:.0f}, and carries {100 * own_share:.0f} % of it itself"
)
ratio = residuals.cost / residuals.allowed
for e in np.argsort(-ratio)[:4]:
    print(
        f"  {graph.edge_label(e):18} {ratio[e]:.2f} times its threshold{', the wrong one' if e == wrong else ''}"
    )

# %% [markdown]
# Remove the closure with the largest cost, solve, and repeat until no edge exceeds its threshold.
# (The edge with the largest cost of all belongs to the odometry, which has to stay: without it
# there is no graph.)

# %%
left, greedy, removed = graph, fooled, []
while greedy.edge_residuals.is_misfit.any():
    ratio = np.where(
        is_odometry(left), 0.0, greedy.edge_residuals.cost / greedy.edge_residuals.allowed
    )
    worst = int(np.argmax(ratio))
    removed.append((int(left.i[worst]), int(left.j[worst])))
    left = left.without_edges(np.arange(left.num_edges) == worst)
    greedy = solvers.solve(left)
print(
    f"removed {removed}; {pgo.absolute_trajectory_error(greedy.poses, truth):.2f} m off, {greedy!r}"
)

# %% [markdown]
# This removed a right closure. Now nothing contradicts the wrong one enough, no edge stands out,
# and the map is worse than before. (The sum of the costs still shows that something is wrong.)
#
# ## A cost with an upper limit
#
# *Truncated least squares* limits the cost of a closure to $c_e^2$, the quantile 0.99 of the cost
# of a right one (`pgo.chi2_thresholds`), and takes the odometry $O$ to be right:
#
# $$\min_{R, t} \; \sum_{e \in O} r_e^2 + \sum_{e \notin O} \min(r_e^2, c_e^2).$$
#
# Black and Rangarajan (1996) write that as a weighted problem that pays for weights below 1, their
# *outlier process*:
#
# $$\min(r^2, c^2) = \min_{0 \le w \le 1} \; w\, r^2 + (1 - w)\, c^2 .$$
#
# With the weights fixed this is least squares, which we can solve and certify; with the poses
# fixed, $w = 1$ where $r^2 < c^2$, and 0 elsewhere. Alternating between the two gets stuck at once:
# an edge that a bad initial estimate puts beyond $c$ never returns. *Graduated non-convexity*
# (Yang, Antonante, Tzoumas and Carlone, RA-L 2020) starts with another penalty on the weights,
#
# $$\Phi_\mu(w) = \frac{\mu (1 - w)}{\mu + w}\, c^2 \;\to\; (1 - w)\, c^2 \quad (\mu \to \infty),$$
#
# for which the minimum over $w$ of $w\, r^2 + \Phi_\mu(w)$ is where
# $r^2 = \mu (\mu + 1)\, c^2 / (\mu + w)^2$, that is (their equation 14)
#
# $$w = \min\Bigl(1, \max\Bigl(0, \frac{c}{r} \sqrt{\mu (\mu + 1)} - \mu\Bigr)\Bigr).$$
#
# For $\mu = 1 / (2 \max_e r_e^2 / c_e^2 - 1)$ (their remark 5) the surrogate is convex in $r$
# wherever a residual is; every doubling brings it closer to the truncated cost.
#
# ## The loop by hand


# %%
def by_hand(graph):
    problem, free = pgo.PGOProblem(graph), ~is_odometry(graph)
    allowed = pgo.chi2_thresholds(problem, 0.99)
    poses, w, film = pgo.odometry_start(graph), np.ones(graph.num_edges), []
    ratio = (problem.edge_costs(poses) / allowed)[free]
    mu = 1.0 / max(1.0, 2.0 * ratio.max() - 1.0)
    while not film or ((w > 0.0) & (w < 1.0)).any():
        w[free] = np.clip(np.sqrt(mu * (mu + 1.0) / ratio) - mu, 0.0, 1.0)
        weighted, v = graph.without_edges(w == 0.0), w[w > 0.0]
        weighted = weighted.with_weights(v * weighted.kappa, v * weighted.tau)
        poses = solvers.polish(pgo.PGOProblem(weighted), poses)
        ratio = (problem.edge_costs(poses) / allowed)[free]
        film.append(w[free].copy())
        mu *= 2.0
    return w == 0.0, poses, np.array(film)


rejected, poses, film = by_hand(graph)
print(
    f"rejected: {[graph.edge_label(e) for e in np.flatnonzero(rejected)]}, after {len(film)} solves"
)

figure, (left_axes, right_axes) = plt.subplots(1, 2, figsize=(7, 2.4), layout="constrained")
r = np.linspace(0.0, 3.0, 200)
for mu in (0.05, 0.3, 2.0, 1e3):
    left_axes.plot(r, solvers.RobustLoss.TRUNCATED.surrogate(r**2, mu), label=f"mu = {mu:g}")
left_axes.plot(r, r**2, ":", color="#999999", label="least squares")
left_axes.set(xlabel="r / c", ylabel="surrogate / c^2", ylim=(0.0, 3.0))
left_axes.legend(fontsize=7)
for weights, is_bad in zip(film.T, is_wrong[~is_odometry(graph)], strict=True):
    right_axes.plot(range(1, len(film) + 1), weights, color="#D55E00" if is_bad else "#999999")
_ = right_axes.set(xlabel="solve", ylabel="weights of the closures")

# %% [markdown]
# At first all closures have small weights. The wrong closure contradicts the odometry more than the
# others do. With every doubling the others gain weight, and the wrong one does not.
#
# ## The library agrees
#
# `solvers.GNC()` takes one Newton step per set of weights, scales the thresholds where the file's
# precisions do not fit its residuals, and runs twice or more on a small graph, with different
# settings and starts. In each attempt clusters of rejected closures are added, even if their
# residuals are large, where the least cost hardly rises once the map has followed them together.
# Closures without which the others fit far better are dropped, even if their residuals are small
# (data snooping, Baarda 1968). The answer is the attempt of the least truncated cost. The edges
# that are kept are solved and certified like any graph.

# %%
robust = solvers.solve(graph, robust=solvers.GNC())
print(robust)

# %% [markdown]
# The line `given` (`Solution.robust.conditional`) says what is proven. The bound holds in exact
# arithmetic, for *the edges kept*. A heuristic decided which edges these are: it is proven neither
# that the rejected edge is wrong, nor that no other set has a lower truncated cost. The verdict
# also says how many closures constrain the map, here six. Fewer edges are certified more easily,
# and a tree always is, so a certificate alone says little. If only a tree is left, the verdict is
# UNCHECKED, and if so loose a map is expected to fit wrong closures by chance, it is DOUBTFUL.
#
# ## Huber's loss: convex, but never zero weight
#
# Huber's loss is $r^2$ up to $c^2$ and $2 c r - c^2$ beyond. It is convex in $r$, adds no local
# minima, and needs no decision on edges (`solvers.IRLS`, iteratively reweighted least squares,
# weights $\min(1, c / r)$). A wrong edge loses weight, but never all of it; its force on the poses
# stays at $c$, however wrong it is.

# %%
huber = solvers.run(solvers.IRLS(), pgo.PGOProblem(graph))
huber_weight = np.sqrt(min(1.0, huber.state.thresholds[wrong] / huber.state.costs[wrong]))
errors = {
    "without it": pgo.absolute_trajectory_error(without.poses, truth),
    "least squares": pgo.absolute_trajectory_error(fooled.poses, truth),
    "Huber": pgo.absolute_trajectory_error(huber.poses, truth),
    "truncated": pgo.absolute_trajectory_error(robust.poses, truth),
}
print(*(f"{name:14} {error:.2f} m off" for name, error in errors.items()), sep="\n")
print(f"Huber leaves the wrong edge a weight of {huber_weight:.2f}")

# %% [markdown]
# ## Three closures in ten are wrong
#
# This world has 25 closures. It gets either 11 wrong closures between random poses, or 15 in
# sequences of five that agree with each other. A robot produces such sequences if it drives along a
# corridor and takes it for another one (*perceptual aliasing*).


# %%
def spoil(graph, share, run, seed):
    """Wrong closures, `share` of all, in runs that agree with each other."""
    rng = np.random.default_rng(seed)
    i, j, R, t = [], [], [], []
    while len(i) < round(share / (1 - share) * np.sum(~is_odometry(graph))):
        a, b = rng.integers(0, graph.num_poses - run, 2)
        if abs(a - b) > 10 + run:
            i += range(a, a + run)
            j += range(b, b + run)
            R += [pgo.random_rotations(1, 2, rng)[0]] * run
            t += [rng.uniform(-4.0, 4.0, 2)] * run
    return with_wrong(graph, i, j, pgo.Poses(np.array(R), np.array(t)))


def tell(name, solution, is_wrong, truth):
    kept, residuals = solution.robust.kept, solution.edge_residuals
    print(
        f"{name:10} {is_wrong.sum():2} wrong, of which {(kept & is_wrong).sum():2} kept; "
        f"{(~kept & ~is_wrong).sum()} right ones rejected; gap {solution.certificate.gap_text}; "
        f"costs {residuals.overall:.2f}, allowed {residuals.overall_allowed:.2f}; "
        f"{pgo.absolute_trajectory_error(solution.poses, truth):.2f} m off"
    )


well_closed = world(0, 0.1)
found = {}
for name, run in (("random", 1), ("aliased", 5)):
    many, is_bad = spoil(well_closed, 0.3, run, 0)
    found[name] = solvers.solve(many, robust=solvers.GNC()), is_bad
    tell(name, *found[name], well_closed.truth)
    assert (by_hand(many)[0] == is_bad).all()
print(found["aliased"][0].robust.conditional)

# %% [markdown]
# In both cases our loop and the library reject all wrong closures and no others. Random errors do
# not agree with each other, and the sequences of five do not agree with the odometry, which drifts
# little in 60 steps. The method depends on this.
#
# ## Where it fails, and reports it
#
# Where the edges kept contradict each other strongly, the relaxation may no longer be tight, and
# the certificate shows it. In this example four robots meet rarely, and seven in ten closures are
# wrong. *Pairwise consistency* (`solvers.PCM`, Mangelson et al. 2018) keeps, for every two robots,
# the largest set that agrees with itself, and tests nothing else. The closures of three robots in a
# circle can then contradict each other, and only quantities that are computed from all edges
# together show this.

# %%
team = world(3, 0.05, robots=4, steps=15)
rarely_met, bad_meetings = spoil(team, 0.7, 5, 3)
pairwise = solvers.solve(rarely_met, robust=solvers.PCM())
graduated = solvers.solve(rarely_met, robust=solvers.GNC())
tell("PCM", pairwise, bad_meetings, team.truth)
tell("GNC", graduated, bad_meetings, team.truth)
print(f"PCM: {pairwise.verdict.name}; {pairwise.robust.warning}")
print(f"GNC: {graduated.robust.headline}")

# %% [markdown]
# Graduated non-convexity rejects the wrong closures and no others. That they are more than half of
# all closures is said in the verdict. It is no reason to doubt the map: two attempts from different
# starts keep the same closures, and of those rejected hardly any nearly fits, so that none is
# expected to fit by chance.

# %% [markdown]
# ## Where it fails without a warning
#
# Now the wrong edges agree with each other *and* with the odometry on both sides: poses 45 to 56
# are seen from poses 2 to 13 as they are, but shifted by 2 m, for example because one pillar was
# taken for the next. All twelve closures agree. The odometry between them can be deformed by 2 m at
# little cost, and few of the right closures contradict this.


# %%
def shifted_run(graph, a, b, run, metres):
    """Closures between the true poses a, a + 1, .. and b, b + 1, .., if the latter were some metres further in x."""
    i, j = a + np.arange(run), b + np.arange(run)
    R, t = graph.truth.R, graph.truth.t
    moved = t[j] + np.array([metres, 0.0]) - t[i]
    measured = pgo.Poses(np.swapaxes(R[i], 1, 2) @ R[j], np.einsum("kba,kb->ka", R[i], moved))
    return with_wrong(graph, i, j, measured)


shifted_runs = {}
for name, (base, a) in {"found out": (world(5, 0.1), 2), "silent": (world(11, 0.03), 2)}.items():
    aliased, is_bad = shifted_run(base, a, 45, 12, 2.0)
    shifted_runs[name] = solvers.solve(aliased, robust=solvers.GNC()), is_bad, base.truth
    tell(name, *shifted_runs[name])
silent, is_bad, _ = shifted_runs["silent"]
right_map = solvers.solve(base)
right_panel = ("right closures only", base, right_map.poses, is_bad[: base.num_edges])
draw(
    [right_panel, ("certified", silent.problem.graph, silent.poses, is_bad[silent.robust.kept])],
    base.truth,
)
print(silent.robust.conditional)

# %% [markdown]
# In the first world enough right closures contradict the twelve, and they are rejected. In the
# second the answer keeps all twelve, rejects a right one instead, and is certified *for the edges
# kept*, which are not all right. Nothing shows the error: no edge exceeds its threshold, the sum is
# as expected, most closures are kept, and the truncated cost of the wrong map is less than that of
# the right one, so a better minimiser would not help. Other measurements would help, for example an
# occasional GPS position.

# %%
own, truncated = ~is_odometry(aliased), pgo.chi2_thresholds(pgo.PGOProblem(aliased))


def truncated_cost(poses):
    costs = pgo.PGOProblem(aliased).edge_costs(poses)
    return float(np.sum(np.where(own, np.minimum(costs, truncated), costs)))


print(
    f"truncated cost: right map {truncated_cost(right_map.poses):.0f}, wrong map {truncated_cost(silent.poses):.0f}"
)

# %% [markdown]
# ## Exercises
#
# **1.** With thresholds at the quantile 0.5 instead of 0.99, how many of the *right* closures would
# exceed them?
#
# <details><summary>Answer</summary>
#
# About half, by the definition of a quantile. The threshold sets the share of right edges that one
# is willing to lose.
#
# ```python
# right_world = world(0, 0.1)
# found_there = solvers.solve(right_world)
# costs, free = pgo.PGOProblem(right_world).edge_costs(found_there.poses), ~is_odometry(right_world)
# beyond = np.mean(costs[free] > pgo.chi2_thresholds(pgo.PGOProblem(right_world), 0.5)[free])
# assert 0.1 < beyond < 0.8
# ```
#
# </details>
#
# **2.** What is the surrogate for very large $\mu$, and how does it differ for small $\mu$?
#
# <details><summary>Answer</summary>
#
# The truncated cost $\min(r^2, c^2)$. For small $\mu$ it is a wide parabola: a large error still
# affects the poses.
#
# ```python
# r = np.linspace(0.0, 5.0, 50)
# assert np.allclose(solvers.RobustLoss.TRUNCATED.surrogate(r**2, 1e8), np.minimum(r**2, 1.0), atol=1e-3)
# assert solvers.RobustLoss.TRUNCATED.surrogate(r**2, 0.01)[-1] > 1.0 / 3.0
# ```
#
# </details>
#
# **3.** Increase the error of the wrong edge by half, so that it states that pose 42 lies beyond
# pose 8. By how much does its cost grow, and does the edge stand out now?
#
# <details><summary>Answer</summary>
#
# The additional cost grows, and nearly all of the growth is in the other edges: the share of the
# wrong edge is still below a fifth. Leverage depends on the graph, not on the size of the error.
#
# ```python
# true_place = truth.R[8].T @ (truth.t[42] - truth.t[8])
# further, _ = with_wrong(clean, [8], [42], pgo.Poses(np.eye(2)[None], -0.5 * true_place[None]))
# grown = solvers.solve(further)
# assert grown.objective > 1.2 * fooled.objective
# assert grown.edge_residuals.cost[wrong] < 0.2 * (grown.objective - without.objective)
# ```
#
# </details>

# %%
assert without.is_certified
assert fooled.is_certified
assert residuals.overall > 5 * residuals.overall_allowed
assert own_share < 0.2
assert int(np.argmax(residuals.cost / residuals.allowed)) != wrong
assert removed == [(1, 26)]
assert greedy.is_certified
assert greedy.edge_residuals.overall > greedy.edge_residuals.overall_allowed
assert pgo.absolute_trajectory_error(greedy.poses, truth) > errors["least squares"]
assert (rejected == is_wrong).all()
assert (robust.robust.rejected == rejected).all()
assert robust.is_certified
assert np.isclose(pgo.PGOProblem(clean).objective(poses), robust.objective, rtol=1e-9)
assert np.isclose(robust.objective, without.objective, rtol=1e-9)
assert "not proven" in robust.robust.conditional
assert (
    errors["truncated"]
    < 1.001 * errors["without it"]
    < 0.5 * errors["Huber"]
    < 0.5 * errors["least squares"]
)
assert 0.1 < huber_weight < 1.0
for solution, spoiled in found.values():
    assert solution.is_certified
    assert (solution.robust.rejected == spoiled).all()
assert not pairwise.is_certified
assert pairwise.robust.warning
assert graduated.is_certified
assert graduated.robust.by_chance < 0.05 * graduated.robust.num_closures_kept
assert not graduated.robust.warning
assert (graduated.robust.rejected == bad_meetings).all()
found_out, spoiled, _ = shifted_runs["found out"]
assert (found_out.robust.rejected == spoiled).all()
assert silent.is_certified
assert silent.robust.kept[is_bad].all()
assert silent.robust.rejected[~is_bad].any()
assert not silent.edge_residuals.is_doubtful
assert truncated_cost(silent.poses) < truncated_cost(right_map.poses)
