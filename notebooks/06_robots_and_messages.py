# %% [markdown]
# # 6. What must robots tell each other, and what if a message is lost or a robot dies?
#
# Open with `jupyter lab notebooks/06_robots_and_messages.ipynb`;
# `pip install -e '.[notebooks,fast]'` installs it.
#
# The paper's problem has several robots. Each has its own trajectory, and some of them have met
# (its figure shows four robots with four poses each). No robot holds all measurements. This
# notebook splits a graph, codes SOC as an exchange of messages between neighbours, counts the
# bytes, and then breaks the network.
#
# (The extra `fast` installs METIS, which partitions graphs.)

# %%
import itertools

import matplotlib.pyplot as plt
import numpy as np

import pgo_models as pgo
import solvers
from pgo_models.graphs.separators import report_partition
from pgo_models.plots.curves import plot_decay

plt.rcParams["figure.dpi"] = 150

# %% [markdown]
# ## A picture first
#
# The left picture is the paper's figure 1: four robots with four poses each. A solid line is a
# measurement of a robot's own motion, and a dotted line connects two robots that meet. The right
# picture has only two robots, and shows what has to cross between them. A pose with a dotted line
# is a *separator*, and the other robot holds a *copy* of it. In each round, each robot sends the
# other its current values of the poses that both hold; the method needs nothing else.


# %%
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")


def draw_robots(axes, places, meetings):
    for robot, line in enumerate(places):
        axes.plot(*line.T, "o-", color=COLOURS[robot], markersize=9, label=f"robot {robot}")
    for (a, i), (b, j) in meetings:
        axes.plot(
            *np.array([places[a][i], places[b][j]]).T, ":", color="#555555", linewidth=1.6, zorder=0
        )
    axes.set_aspect("equal")
    axes.axis("off")


square = np.array([[0.0, 0.0], [1.0, 0.3], [1.1, 1.3], [0.1, 1.1]])
four = [square + shift for shift in ([0.0, 2.2], [2.2, 2.2], [0.0, 0.0], [2.2, 0.0])]
meetings = [
    ((0, 1), (1, 0)),
    ((0, 2), (1, 3)),
    ((0, 0), (2, 3)),
    ((1, 1), (3, 2)),
    ((2, 2), (3, 3)),
    ((2, 1), (3, 0)),
]
left_robot = np.array([[0.0, 0.0], [0.7, 0.6], [0.5, 1.5], [0.9, 2.2]])
two = [left_robot, np.array([[4.1, 0.1], [3.3, 0.7], [3.5, 1.6], [3.0, 2.3]])]
figure, (left, right) = plt.subplots(
    1, 2, figsize=(7.5, 3.0), layout="constrained", width_ratios=[1, 1.3]
)
draw_robots(left, four, meetings)
left.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, 0.02), ncols=4, handlelength=1.0)
draw_robots(right, two, [((0, 1), (1, 1)), ((0, 3), (1, 3))])
for robot, other, towards in ((0, 1, -0.55), (1, 0, 0.55)):
    for pose in (1, 3):
        copy = two[other][pose] + [towards, 0.16]
        right.plot(*copy, "o", color=COLOURS[other], markersize=9, markerfacecolor="white")
        right.text(copy[0], copy[1] + 0.16, f"robot {robot}'s copy", ha="center", fontsize=6)
right.annotate("", (2.9, 1.52), (1.1, 1.52), arrowprops={"arrowstyle": "->", "color": COLOURS[0]})
right.annotate("", (1.1, 1.28), (2.9, 1.28), arrowprops={"arrowstyle": "->", "color": COLOURS[1]})
_ = right.text(2.0, 1.6, "x + u of what both have", ha="center", fontsize=7)

# %% [markdown]
# In the right picture two machines agree on four poses. Line for line, this is the consensus of
# [notebook 11](11_admm_across_machines.ipynb). On the paper's grid, cut in half, they agree on 18:

# %%
pair = pgo.load("grid")
halves = pgo.partition(pair, 2, pgo.PartitionMethod.CONTIGUOUS)
together = solvers.run(
    solvers.SOC(robots=halves, coupling=solvers.Coupling.CONSENSUS), pgo.PGOProblem(pair)
)
shared_poses = np.unique(
    np.concatenate([pair.i[halves.cut_edges(pair)], pair.j[halves.cut_edges(pair)]])
)
print(f"two robots, {pair.num_poses} poses, {len(shared_poses)} of them at the seam: {together!r}")

# %% [markdown]
# ## Four robots
#
# `robots` is a grid world of four robots with 40 poses each. An edge between two robots is a
# meeting.

# %%
graph = pgo.load("robots")
problem = pgo.PGOProblem(graph)
n, d = graph.num_poses, graph.d
best = solvers.solve(problem)
pgo.plot_graph(graph, best.poses, "four robots, 160 poses")

# %% [markdown]
# The poses at the boundaries between robots determine what a partition costs. A *separator* has an
# edge to another robot: that neighbour must know its value, so it holds a *copy*. The *vertex
# cover* is a smaller set of poses that touches every edge between robots.

# %%
robots = pgo.partition(graph)
print(report_partition(robots, graph))
print("\nas METIS would split it, were it not given who measured what:\n")
print(report_partition(pgo.partition(graph, 4, pgo.PartitionMethod.METIS), graph))

# %% [markdown]
# ## Consensus: omega is what the copies agree on
#
# Robot $a$ holds its own poses and copies of its neighbours' separators, $x_a$. Its share of the
# cost, $f_a$, contains its own edges and half of each edge to another robot. SOC already has an
# $\omega$ that carries the constraint. Let the *same* $\omega$ be the value on which all copies of
# a pose agree:
#
# $$\begin{aligned}
#   x_a &= \arg\min_x f_a(x) + \tfrac12 \lVert x - z + u_a \rVert_\rho^2 && \text{each robot alone} \\
#   z_i &= \text{mean over the copies of } (x_a + u_a)_i, \text{ its rotation projected to } \mathrm{SO}(d)
#     && \text{between neighbours} \\
#   u_a &\leftarrow u_a + x_a - z && \text{each robot alone}
# \end{aligned}$$
#
# These are steps (a), (b) and (c) of Algorithm 1, with $u_a$ for $B$. Only the rows $(x_a + u_a)_i$
# of poses with more than one copy cross the network: $d (d + 1)$ numbers per pose. No robot sees
# the measurements of another robot, or its other poses.

# %%
owner, cut = robots.robot, robots.cut_edges(graph)
is_at = [
    (owner[graph.i] == a) | (owner[graph.j] == a) for a in range(4)
]  # edges that robot a knows
held = [np.unique(np.concatenate([graph.i[edges], graph.j[edges]])) for edges in is_at]
copies = np.bincount(np.concatenate(held), minlength=n)
links = {
    (a, b): np.intersect1d(held[a], held[b]) for a, b in itertools.permutations(range(4), 2)
}  # held by both

start = pgo.chordal_start(problem)
sizes = np.abs(np.linalg.eigvalsh(pgo.multipliers(problem, start))).max(axis=1)
rho = 8.0 * np.quantile(sizes, 0.8)  # see notebook 4
relative_rho_t = 0.05  # of the diagonal of M, for the translations of shared poses


def rows_of(poses):
    return np.concatenate([poses, (n + d * poses[:, None] + np.arange(d)).ravel()])


A, w = problem.residual_matrix
penalty = np.concatenate(
    [relative_rho_t * problem.M.diagonal()[:n] * (copies > 1), np.full(n * d, rho)]
)
penalty /= np.concatenate([copies, np.repeat(copies, d)])  # shared by the copies
local = []
for a in range(4):
    share = np.where(cut, 0.5, 1.0) * is_at[a]
    M_a = (A.T @ (A * (w * np.concatenate([share, np.repeat(share, d)]))[:, None])).toarray()
    local.append(M_a[np.ix_(rows_of(held[a]), rows_of(held[a]))])

# %% [markdown]
# Below is the loop. Each robot keeps the newest rows that it has *received* from each neighbour
# (`heard`). `arrives(k, a, b)` states whether the message from a to b arrives in round k, and
# `is_alive(k, a)` whether robot a takes part. For now, both are always true.


# %%
def converse(
    rounds, arrives=lambda k, a, b: True, is_alive=lambda k, a: True, only_what_arrived=False
):
    D = [penalty[rows_of(held[a])][:, None] for a in range(4)]
    solve_a = [np.linalg.inv(local[a] + np.diag(D[a][:, 0]) / 2) for a in range(4)]
    z = [start.stacked()[rows_of(held[a])] for a in range(4)]
    u = balanced(z, D)
    x, heard = [None] * 4, {}
    for k in range(rounds):
        alive = [a for a in range(4) if is_alive(k, a)]
        for a in alive:
            x[a] = solve_a[a] @ (D[a] / 2 * (z[a] - u[a]))
        if only_what_arrived:
            heard = {}
        for (a, b), poses in links.items():
            if k == 0 or (a in alive and b in alive and arrives(k, a, b)):
                heard[a, b] = (x[a] + u[a])[np.searchsorted(rows_of(held[a]), rows_of(poses))]
        for a in alive:
            z[a] = mean_of_copies(a, x[a] + u[a], heard)
            u[a] = u[a] + x[a] - z[a]
        yield agreed(z)


def mean_of_copies(a, own, heard):
    rows, total, count = rows_of(held[a]), own.copy(), np.ones(len(own))
    for (b, receiver), received in heard.items():
        if receiver == a:
            places = np.searchsorted(rows, rows_of(links[b, a]))
            total[places] += received
            count[places] += 1
    mean = total / count[:, None]
    R = mean[len(held[a]) :].reshape(-1, d, d).transpose(0, 2, 1)
    mean[len(held[a]) :] = pgo.project_to_rotations(R).transpose(0, 2, 1).reshape(-1, d)
    return mean


def balanced(z, D):
    """u_a that holds every robot's forces in balance at the start, but for a mean over the copies."""
    u = [
        np.divide(-2 * local[a] @ z[a], D[a], out=np.zeros_like(z[a]), where=D[a] > 0)
        for a in range(4)
    ]
    mean = np.zeros((problem.side, d))
    for a in range(4):
        shared_by = np.concatenate([copies[held[a]], np.repeat(copies[held[a]], d)])
        mean[rows_of(held[a])] += u[a] / shared_by[:, None]
    return [u[a] - mean[rows_of(held[a])] for a in range(4)]


def agreed(z):
    """Rotations of every pose as its owner has them, (n, d, d)."""
    omega = np.empty((n, d, d))
    for a in range(4):
        R = z[a][len(held[a]) :].reshape(-1, d, d).transpose(0, 2, 1)
        omega[held[a][owner[held[a]] == a]] = R[owner[held[a]] == a]
    return omega


def gap(omega):
    return problem.objective(problem.with_best_translations(omega)) / best.objective - 1


# %% [markdown]
# ## The library agrees
#
# With the same penalties, without acceleration, and with one pass of (a), (b), (c) per message,
# `SOC(robots=...)` has the same iterates. (By default its robots repeat the three steps on their
# private poses between two messages.)

# %%
soc = solvers.SOC(
    robots=robots,
    penalty=solvers.FixedPenalty(rho),
    translation_penalty=relative_rho_t,
    acceleration=None,
    local_passes=1,
)
states = list(itertools.islice(solvers.iterate(soc, problem), 31))
ours = list(converse(30))
difference = max(
    np.abs(state.omega - omega).max() for state, omega in zip(states[1:], ours, strict=True)
)
print(f"differs from ours by {difference:.0e} in 30 rounds")
print("gap after 10, 20, 30 rounds:", *(f"{gap(omega):.0e}" for omega in ours[9::10]))

# %% [markdown]
# ## Rounds and bytes
#
# `solve(problem, robots=...)` runs everything on robots: the initial estimate, SOC, Newton's method
# and the certificate. Its *ledger* counts what crosses the network. There are two ways to share the
# work. With `CONSENSUS`, as above, the robots exchange messages with their neighbours. With
# `SUBSTRUCTURED`, they eliminate their private poses and a driver solves for the vertex cover; the
# iterates are those of one robot that holds the whole graph.

# %%
for coupling in (solvers.Coupling.CONSENSUS, solvers.Coupling.SUBSTRUCTURED):
    pipeline = solvers.Pipeline(soc=solvers.SOC(coupling=coupling, robots=robots, tolerance=2e-3))
    shared = solvers.solve(problem, pipeline, robots=robots)
    stages = ", ".join(f"{stage.name} {stage.iterations}" for stage in shared.stages)
    print(
        f"{coupling.name:14} {shared.certificate.verdict.name}   {shared.ledger}\n{'':14} iterations: {stages}"
    )
pooled = 8 * graph.num_edges * (d * (d + 1) + 2)
print(f"all measurements sent to one place once: {pooled} bytes")

# %% [markdown]
# The last number is the alternative to exchanging messages: collecting all measurements in one
# place. Here it is smaller, because this graph is small, and a certified solution takes more bytes
# than its measurements. The advantage of the messages is that no robot needs to hold all
# measurements. The bytes of the messages grow with the boundaries between robots and with the
# rounds; the bytes of pooling grow with the whole graph.
#
# That is true of the robots, and not of the process that calls `solve`. In this notebook it has read
# the whole graph. Where robots read files of their own (`pgo solve FOLDER`), it never has the
# measurements within a robot, but those between two robots pass through it, as all messages do. And
# a solve without a driver (`--driver-memory 0`) collects all poses in it, to evaluate $F$.
#
# ## Lost messages
#
# A share of all messages is lost, without notice. A robot that receives nothing uses the newest
# rows that it has.

# %%
rounds = 120


def lossy(share, seed=0, **options):
    rng = np.random.default_rng(seed)
    return [
        gap(omega)
        for omega in converse(rounds, arrives=lambda k, a, b: rng.random() >= share, **options)
    ]


losses = {f"{share:.0%} lost": np.array(lossy(share)) for share in (0.0, 0.3, 0.6, 0.9)}
losses["30% lost, only what arrived"] = np.array(lossy(0.3, only_what_arrived=True))
plot_decay([(name, np.maximum(gaps, 1e-12)) for name, gaps in losses.items()], "F / F* - 1")

# %% [markdown]
# The effect is small. With 30 % of the messages lost there is hardly a difference, and with nine
# lost out of ten the run is only slower. *Where* it ends does not change at all: once nothing
# changes any more, the newest copy is the current one, and the equations of a fixed point are those
# without losses.
#
# The last curve shows a mistake. There a robot averages only over the rows that arrived **in this
# round**. This sounds reasonable, but it destroys the method: whenever a message is missing, the
# mean is taken over other copies, $z$ jumps, and $u$ accumulates the jump as if it were a residual.
#
# ## A robot that dies and comes back
#
# Robot 2 stops after 10 rounds. Its neighbours continue with its last message. In one run it
# returns after 60 rounds, with the state from its disk; in the other run it never returns.

# %%
returns = np.array(
    [gap(omega) for omega in converse(rounds, is_alive=lambda k, a: a != 2 or not 10 <= k < 60)]
)
never = np.array([gap(omega) for omega in converse(rounds, is_alive=lambda k, a: a != 2 or k < 10)])
figure, axes = plt.subplots(figsize=(5.0, 2.8), layout="constrained")
axes.axvspan(10, 60, color="#dddddd", label="robot 2 is dead")
axes.semilogy(losses["0% lost"], color="#0072B2", label="all well")
axes.semilogy(never, color="#D55E00", label="it never returns")
axes.semilogy(returns, color="#009E73", label="it returns")
axes.set_xlabel("round")
axes.set_ylabel("F / F* - 1")
_ = figure.legend(fontsize=8, loc="outside right upper")

# %% [markdown]
# While the robot is absent, the others converge to the best answer that agrees with its last
# message, and a gap remains. When it returns, the run continues as if the others had been waiting,
# because its $u$ is still right. Without its $u$, or without its measurements, that would not be
# so.

# %% [markdown]
# The library's faults do the same to whole solves: messages are lost or late, or a robot is silent
# for a while. No robot waits and nothing is summed over robots, so the steps are over-relaxed
# instead of accelerated.

# %%
robots = pgo.partition(graph, 3)
consensus = solvers.SOC(robots=robots, coupling=solvers.Coupling.CONSENSUS, tolerance=1e-4)
faults = {
    "all well": solvers.Faults(),
    "20 % lost": solvers.Faults(loss=0.2, seed=1),
    "up to 5 rounds late": solvers.Faults(max_delay=5, seed=1),
    "robot 2 silent for 20": solvers.Faults(silent_robot=2, silent_from=3, silent_rounds=20),
}
faulty = {
    name: solvers.solve(
        graph, solvers.Pipeline(soc=consensus), robots=solvers.Robots(robots, faults=kind)
    )
    for name, kind in faults.items()
}
figure, axes = plt.subplots(figsize=(5.4, 2.8), layout="constrained")
for (name, solution), colour in zip(faulty.items(), COLOURS, strict=True):
    history = solution.stages[1].history
    label = f"{name}: gap {solution.gap:.0e} in the end"
    axes.semilogy(history.k[1:], history.primal_residual[1:], color=colour, label=label)
axes.axvspan(3, 23, color="#eeeeee", zorder=0)
axes.set(
    xlabel="round of SOC", ylabel="primal residual", title="grey: robot 2 silent, in one of them"
)
axes.title.set_fontsize(9)
_ = figure.legend(fontsize=8, loc="outside lower center", ncols=2)

# %% [markdown]
# ## Exercises
#
# **1.** How many numbers cross the network in one round of messages between the four robots?
#
# <details><summary>Answer</summary>
#
# $d (d + 1)$ for every pose and every pair that holds it.
#
# ```python
# numbers = sum(d * (d + 1) * len(poses) for poses in links.values())
# assert numbers == sum(len(rows_of(poses)) * d for poses in links.values())
# assert 8 * numbers < pooled
# ```
#
# </details>
#
# **2.** *No* message arrives after the first round. Where does the run end?
#
# <details><summary>Answer</summary>
#
# Every robot converges to the best answer that agrees with the one message that it received. A gap
# remains at every boundary, as with the dead robot.
#
# ```python
# alone = [gap(omega) for omega in converse(rounds, arrives=lambda k, a, b: False)]
# assert alone[-1] > 1e-4 > 10 * losses["60% lost"][-1]
# assert abs(alone[-1] - alone[-20]) < 1e-2
# ```
#
# </details>
#
# **3.** Does *which* messages get lost change where the run ends? Try other seeds.
#
# <details><summary>Answer</summary>
#
# No. At a fixed point every copy is equal to $z$ and every $u$ is unchanged, whichever message
# arrived last.
#
# ```python
# ends = [lossy(0.6, seed=seed)[-1] for seed in (1, 2)]
# assert max(ends) < 1e-5
# ```
#
# </details>

# %%
assert together.status is solvers.Status.CONVERGED
assert difference < 1e-8
assert gap(ours[-1]) < 1e-3
assert shared.is_certified
assert np.isclose(shared.objective, best.objective, rtol=1e-6)
assert losses["60% lost"][-1] < 1e-6
assert losses["90% lost"][-1] < losses["90% lost"][20]
assert losses["30% lost, only what arrived"][-1] > 1e-2
assert returns[-1] < 1e-4 < never[-1]
assert np.ptp(never[-20:]) < 1e-4
assert all(solution.is_certified for solution in faulty.values())
