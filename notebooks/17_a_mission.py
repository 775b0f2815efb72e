# %% [markdown]
# # 17. What does a team know while its mission goes on?
#
# Open with `jupyter lab notebooks/17_a_mission.ipynb`;
# `pip install -e '.[notebooks,fast,team]'` installs it.
#
# - **Prerequisites:** [notebook 5](05_sdp_and_certificates.ipynb), what a certificate is, and
#   [notebook 6](06_robots_and_messages.ipynb), robots and the separators between them.
# - **Time:** 25 minutes
# - **Next:** [notebook 18](18_the_files_own_cost.ipynb), what information matrices change
#
# In notebook 6 the graph was there before the robots began to talk. Here it grows while they drive.
# Four robots measure for three minutes, each keeps what it has measured, and messages travel between
# them with a delay. For one minute the robot that organises the solves is out of reach. At every moment
# each robot has a map and a certificate, and the certificate says which robots it *covers*.
# This notebook simulates the mission, derives what such a certificate proves, and ends with what no
# team can know.
#
# `solvers.Robot` is a robot without sockets, threads or a clock, so the network can be a loop of
# twenty lines. What only draws is in [`drawings/a_mission.py`](drawings/a_mission.py).

# %%
import heapq
import itertools
import time
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from drawings.a_mission import draw_drivers, draw_world, mission_film
from drawings.checks import NamedNumbers

import pgo_models as pgo
import solvers

plt.rcParams["figure.dpi"] = 120

# %% [markdown]
# ## What the robots will measure
#
# The robots Anna, Ben, Carl and Dora drive through the streets of a grid world, 36 poses each, a pose
# every five seconds. An edge can be measured when both of its poses exist. It belongs to the robot
# that arrived last: this robot recognises a place where somebody has been before. So every edge is
# kept by exactly one robot, also an edge between two robots.

# %%
names = ["anna", "ben", "carl", "dora"]
world = pgo.grid_world(4, 36, np.random.default_rng(0), d=2)
step = np.arange(world.num_poses) % 36
driven_in = step // 2  # the ten seconds in which a pose is driven to
last_pose = np.where(step[world.j] >= step[world.i], world.j, world.i)
measured_in = driven_in[last_pose]
measured_by = world.robots[last_pose]
between = world.robots[world.i] != world.robots[world.j]
print(f"{world.num_poses} poses, {world.num_edges} edges, {between.sum()} of them between robots")
draw_world(world, names)

# %% [markdown]
# The large dots are where the robots start. The coloured lines are the true trajectories, drawn a
# little apart where robots share a street, and the dark lines are the edges between places that are
# not consecutive poses of a robot.
#
# ## A team, and a network in twenty lines
#
# A `Robot` is made of its name, the names of the team, and a secret of the team. `Weighting.ISOTROPIC`
# asks for the paper's cost $F$. With `Sharing.INTERFACE` the edges inside a robot's part stay with it;
# with `Sharing.MEASUREMENTS` all others get them, and what a certificate says is the same.
# Measurements are added in batches, every ten seconds, since new measurements make a new solve begin.

# %%
KEY = b"a secret of the whole team"


def new_team(sharing=solvers.Sharing.INTERFACE, patience=5.0, keys=None):
    """Robots without measurements; `keys` replaces the secret of some."""
    settings = {"sharing": sharing, "patience": patience, "weighting": pgo.Weighting.ISOTROPIC}
    secrets = dict.fromkeys(names, KEY) | (keys or {})
    return {name: solvers.Robot(name, names, secrets[name], **settings) for name in names}


def measure(robots, ten):
    """Give every robot its new poses and edges."""
    for pose in np.flatnonzero(driven_in == ten).tolist():
        robots[names[world.robots[pose]]].add_pose(pose)
    for e in np.flatnonzero(measured_in == ten).tolist():
        robots[names[measured_by[e]]].add_edge(
            int(world.i[e]),
            int(world.j[e]),
            world.R_ij[e],
            world.t_ij[e],
            kappa=float(world.kappa[e]),
            tau=float(world.tau[e]),
        )


# %% [markdown]
# The network has a clock of its own, with 20 steps a second. A message is on its way for 10 to 50
# milliseconds, overtakes others, and does not arrive if its sender or its receiver is out of reach.
# Computing takes no time on this clock: it stands still while a robot computes, beside its calls.
# Every second we note what each robot knows. Nothing here looks into a message: `receive` takes bytes
# and `outbox` returns them.


# %%
class Known(NamedTuple):
    """What a robot knows at a moment, and the bytes that it has sent to each other robot."""

    outcome: object  # of the last solve that succeeded
    failure: str  # why the last solve failed, if it did
    poses: dict
    lines: int  # of measurements that it has
    sent: dict


def knowledge_of(robot):
    lines = robot.revision.num_lines
    return Known(robot.outcome, robot.failure, robot.poses, lines, robot.ledger.sent)


# %%
def mission(robots, away, seconds=180, lost=0.0):
    """Drive, measure and send; what each robot knows after every second."""
    rng, count = np.random.default_rng(0), itertools.count()
    in_the_air, log = [], []
    robot_away, begins, ends = away
    for k in range(20 * seconds):
        now = k / 20
        if k % 200 == 0:
            measure(robots, k // 200)
        while in_the_air and in_the_air[0][0] <= now:
            _, _, sender, message = heapq.heappop(in_the_air)
            is_cut = robot_away in (sender, message.to) and begins <= now < ends
            if not is_cut and rng.random() >= lost:
                robots[message.to].receive(message.data, now)
        for name, robot in robots.items():
            robot.tick(now)
            while robot.is_computing:
                time.sleep(1e-4)
            for message in robot.outbox():
                arrival = now + rng.uniform(0.01, 0.05)
                heapq.heappush(in_the_air, (arrival, next(count), name, message))
        if k % 20 == 19:
            log.append({name: knowledge_of(robot) for name, robot in robots.items()})
    return log


# %% [markdown]
# Anna, whose name comes first, drives the solves: she asks the others for their parts, finds the
# solution and tells everybody. She is the one whom we take out of reach, from second 80 to second 140.

# %%
AWAY = ("anna", 80, 140)
robots = new_team()
log = mission(robots, AWAY)


def bound_of(known):
    """Lower bound that a robot knows; zero is one of any sum of squares."""
    return 0.0 if known.outcome is None else known.outcome.solution.lower_bound


def error_of(now, group):
    """Error of the poses of a group of robots to the truth, metres, best aligned."""
    poses = {pose: value for name in group for pose, value in now[name].poses.items()}
    ids = sorted(poses)
    estimate = pgo.Poses(np.stack([poses[k][0] for k in ids]), np.stack([poses[k][1] for k in ids]))
    return pgo.absolute_trajectory_error(estimate, world.truth[ids])


# %% [markdown]
# The table below has a line for what Ben knows every ten seconds, and while Anna is away another for
# her. If the last solve has failed, `failure` says why, and the robot keeps the outcome before it, if
# there is one. An outcome has `revisions`: how many lines of measurements it holds for, by robot. (A
# pose is a line, and so is an edge.) So a robot can count how many lines it has `new` since. The error
# is that of the map of all robots that have this outcome.

# %%
print("   s  who   driver  verdict    bound    gap      error    sent  new  covered")
for second in range(10, 181, 10):
    now = log[second - 1]
    for name in ("ben", "anna") if AWAY[1] < second <= AWAY[2] else ("ben",):
        known = now[name]
        if known.failure:
            print(f"{second:4}  {name:4}  {known.failure.split(';')[0]}")
        if known.outcome is None:
            continue
        term, proven = known.outcome.term, known.outcome.solution.certificate
        sent = sum(known.sent.values())
        group = [n for n in names if now[n].outcome.term == term]
        print(
            f"{second:4}  {name:4}  {term.driver:6}  {proven.verdict.name:9}  {proven.lower_bound:7.3f}"
            f"  {proven.printed_gap:.1e}  {error_of(now, group):.2f} m  {sent / 1000:3.0f} kB"
            f"  {known.lines - known.outcome.revisions[name].num_lines:3}  {', '.join(known.outcome.covered)}"
        )

# %% [markdown]
# The mission has four parts, and they can be read off the last column.
#
# - Until second 40 the robots have not all met. Robots that edges join are a part of the team and have
#   a map of their own: Ben is alone at first, and at second 40 he has met Anna and Carl.
# - From second 50 to 80 everybody knows of one certificate, which covers all.
# - From second 90 to 140 Anna and the others know different things. Anna drives a solve of her own
#   edges. Ben, whose name comes first among the others, drives theirs: at first without Dora, and we
#   shall see why, and from second 110 on there is a certificate for the three.
# - A few seconds after Anna has come back, one certificate covers all again.
#
# Every certificate is `CERTIFIED`, with a gap near $10^{-13}$, or `EXACT` where nothing is measured
# twice, and this is no contradiction to the error of the map. The error is what the noise does to the best map there is, and it falls to 0.15 m
# as closures arrive. The gap says that this map *is* the best one for the edges that are covered.
#
# ## The mission as a film
#
# For comparison, one machine that is told everything at once solves the graph of all that has been
# measured. Its least cost is the wide grey line below the map.


# %%
def solved(graph):
    return solvers.solve(pgo.PGOProblem(graph, weighting=pgo.Weighting.ISOTROPIC))


optima = []
for ten in range(18):
    so_far = world.edge_subgraph(np.flatnonzero(measured_in <= ten))
    optima.append(solved(so_far).objective if so_far.is_connected else np.nan)
mission_film(world, log, AWAY, measured_in, optima)

# %% [markdown]
# Solid lines are maps of a solve of all that their robots have, and dotted ones are out of reach or out
# of date. The maps of different groups have nothing to do with each other; each is laid on the truth
# by itself for the picture. In the curves below, blue is the bound that Anna knows, orange (mostly
# under another curve) that of Ben, and black what the two prove together while they are apart. None of
# them is ever above the grey line.
#
# The next picture shows, for every robot and second, who drove the solve of its latest certificate.
# The dashed lines are the moments when Anna goes and comes back.

# %%
draw_drivers(log, AWAY)

# %% [markdown]
# Nobody elects a driver. Each robot looks at whom it has heard of in the last five seconds and drives
# if its own name comes first. Two robots may both believe it for a while, as Anna and Ben do here.
# That costs messages, but can do no harm: each certificate says whom it covers, and how many lines of
# each.
#
# ## What a certificate with `covered` proves
#
# Let $E_r$ be the edges that robot $r$ keeps, and $F_r$ the part of the cost that they make up. Every
# edge is kept by one robot, so the cost of the team is a sum, and that of a group $A$ of robots is a
# part of this sum:
#
# $$\begin{aligned}
#   F &= \sum_r F_r, \qquad F_A = \sum_{r \in A} F_r, \\
#   F_r(R, t) &= \sum_{(i,j) \in E_r} \kappa_{ij} \|R_j - R_i R_{ij}\|^2
#   + \tau_{ij} \|t_j - t_i - R_i t_{ij}\|^2.
# \end{aligned}$$
#
# Let $F_A^* = \min F_A$ be the least value over all poses. A certificate that covers $A$ has a number
# `lower_bound` with $\ell_A \le F_A^*$: no poses whatsoever, neither the ones found nor any others,
# make the measurements of the robots in $A$ cost less. It says nothing of the measurements of others.
# If one machine had the edges of Ben, Carl and Dora at second 140, it would prove the same number.

# %%
at_140 = log[139]
edges_at_140 = np.flatnonzero(measured_in < 14)
by_others = edges_at_140[measured_by[edges_at_140] > 0]
one_machine = solved(world.edge_subgraph(by_others))
bound_of_others = at_140["ben"].outcome.solution.lower_bound
num_named = at_140["ben"].outcome.solution.num_absent
print(f"bound of ben, carl and dora {bound_of_others:.9f}")
print(f"least cost, in one place    {one_machine.objective:.9f}")
print(f"poses of anna that their edges name: {num_named}")

# %% [markdown]
# Their edges also name poses of Anna, since they have recognised places where she was. Nobody in the
# group has measured how Anna went from one of these places to the next, so they are unknowns like any
# others. The minimum over them is part of $F_A^*$, and the bound is valid wherever Anna was.
#
# ## The bound of a part is a bound of the whole
#
# Each $F_r$ is a sum of squares and nowhere negative. Leaving out terms can therefore only lower the
# cost of given poses, $F_A(x) \le F(x)$, and with the poses $x^*$ that are best for all,
#
# $$\ell_A \le F_A^* \le F_A(x^*) \le F(x^*) = F^*.$$
#
# What Ben proves without Anna is thus not wasted: it bounds the cost of the whole team from below,
# although he does not know what Anna has measured. Moreover, if the groups $A$ and $B$ have no robot
# in common, they keep no edge in common, and
#
# $$\ell_A + \ell_B \le F_A^* + F_B^* \le F_A(x^*) + F_B(x^*) \le F^*.$$
#
# The bounds of two parts may be added. Only the bounds: the *cost* $F_A^* + F_B^*$ is not one of
# any map, since the two groups may place the same pose differently.

# %%
print("   s  groups                             proven together  least cost of all")
sums = []
for second in range(90, 141, 10):
    outcomes = [known.outcome for known in log[second - 1].values()]
    bounds = {outcome.covered: outcome.solution.lower_bound for outcome in outcomes}
    together, optimum = sum(bounds.values()), optima[second // 10 - 1]
    sums.append((set(bounds), together, optimum))
    groups = " | ".join(", ".join(group) for group in bounds)
    print(f"{second:4}  {groups:34}  {together:14.3f}  {optimum:17.3f}")

# %% [markdown]
# No two groups have a robot in common, so all their bounds may be added. (Had one robot been in two of
# them, its edges would have counted twice, and only the larger bound would have been proven.) At second
# 140 the two parts together account for 53.8 of 99.7. What is missing are contradictions that show only
# if the edges of all are seen together.
#
# ## Why it does not matter who drives
#
# The driver has not seen the measurements. How can it know a bound of their cost? By notebook 5 the
# bound is $\sum_i \operatorname{tr} \Lambda_i$, provided that $S = M - \operatorname{blockdiag}(0, \Lambda)$ is
# positive semidefinite. Here $M$ is the matrix of $F$ in all rotations and translations. It is a sum of
# what the edges of each robot contribute, so all that is needed is to decide the sign of a sum.
#
# Call the ends of edges between robots *separators*, $\Gamma$, and the other poses of robot $r$ its
# interior, $r$. No edge joins the interiors of two robots, so these blocks of $S$ are zero. Completing
# squares in the interiors one after the other gives
#
# $$S \succeq 0 \iff S_{rr} \succ 0 \text{ for all } r \quad \text{and} \quad
#   \sum_r \Bigl( S^{(r)}_{\Gamma\Gamma} - S_{\Gamma r}\, S_{rr}^{-1}\, S_{r \Gamma} \Bigr) \succeq 0$$
#
# (for $S_{rr}$ that are not singular). Robot $r$ computes the matrix in brackets from its own edges.
# $S^{(r)}$ is its share of $S$. The driver adds four matrices, and a sum does not depend on who adds.
# The interiors never leave their robots. Here this is by hand, with the last map of the team. Moving
# all poses together changes no cost, so $S$ has three zero eigenvalues; with one pose held fixed, it
# must be positive definite. The library also takes off a little for rounding, which this cell does
# not.

# %%
problem = pgo.PGOProblem(world, weighting=pgo.Weighting.ISOTROPIC)
found = {pose: value for name in names for pose, value in log[-1][name].poses.items()}
R, t = (np.stack([found[pose][part] for pose in range(world.num_poses)]) for part in (0, 1))
Lambda = pgo.multipliers(problem, pgo.Poses(R, t))
S = pgo.certificate_matrix(problem, Lambda).toarray()


def rows_of(poses):
    """Rows of these poses in S: first come all translations, then two rows of every rotation."""
    n = world.num_poses
    return np.concatenate([poses, n + 2 * poses, n + 2 * poses + 1])


# %%
separators = np.unique([world.i[between], world.j[between]])
kept = rows_of(separators[1:])  # the first one is held fixed
on_separators = S[np.ix_(kept, kept)].copy()
interiors = [np.setdiff1d(np.flatnonzero(world.robots == r), separators) for r in range(4)]
for name, interior in zip(names, interiors, strict=True):
    own = rows_of(interior)
    L = np.linalg.cholesky(S[np.ix_(own, own)])  # raises an error unless it is positive definite
    half = np.linalg.solve(L, S[np.ix_(own, kept)])
    on_separators -= half.T @ half
    print(f"{name}: {len(interior)} poses inside, {36 - len(interior)} separators")
least = np.linalg.eigvalsh(on_separators)[0]
by_hand = np.trace(Lambda, axis1=1, axis2=2).sum()
team_bound = log[-1]["ben"].outcome.solution.lower_bound
print(f"{len(separators)} separators; smallest eigenvalue of their matrix {least:.4f}")
print(f"bound by hand {by_hand:.9f}, of the team {team_bound:.9f}")

# %% [markdown]
# ## Where it fails
#
# **Parts without a common edge.** Until second 40, and for a while after Anna has gone, there is no
# certificate for all who can hear each other. Here are the groups at two of these moments, and the parts
# into which the edges of Ben, Carl and Dora fall at second 90.

# %%
for second in (20, 90):
    covered = {known.outcome.covered for known in log[second - 1].values()}
    print(f"{second} s,", " | ".join(sorted(", ".join(group) for group in covered)))
without_anna = world.edge_subgraph(np.flatnonzero((measured_in < 9) & (measured_by > 0)))
for part in without_anna.components():
    owners = np.unique(world.robots[without_anna.pose_ids[part]])
    print("   a part with poses of", ", ".join(names[k] for k in owners))

# %% [markdown]
# How two parts lie to each other is not determined if no edge joins them, so there is no map of both,
# and each part solves for its own. At second 90, the part of Ben and Carl and the part of Dora both
# name poses of Anna, but only Anna knows how these lie to each other. Ten to twenty seconds later Ben
# recognises places where Dora was, and the three are connected without Anna. What a part proves is
# still a bound of the whole team, as we have seen.
#
# **A robot without the key.** Dora has another secret. Her messages do not pass the check of their
# seal, and are dropped and counted. The others wait for `patience` seconds, and then go on as if she
# were not there.

# %%
with_stranger = new_team(
    solvers.Sharing.MEASUREMENTS, keys={"dora": b"some other secret, not ours"}
)
log_of_stranger = mission(with_stranger, ("nobody", 0, 0))
for name in ("ben", "dora"):
    robot = with_stranger[name]
    print(f"{name}: covered {robot.covered}, absent {robot.absent}, dropped {robot.ledger.dropped}")

# %% [markdown]
# **A robot out of reach learns nothing, and is slow to notice.** A message cannot reach Anna, and the
# others cannot be told that she is fine. For some seconds the silence is not noticed at all. Meanwhile
# everybody goes on measuring. Here is what the certificates of Anna and Ben hold for, and how many
# lines there are: the first number of each pair is in `revisions` of the outcome, and we, who see all
# robots at once, add the second.

# %%
for second in (80, 83, 87, 140, 143):
    now = log[second - 1]
    for name in ("anna", "ben"):
        if now[name].outcome is None:
            print(f"{second:4}  {name:4}  no certificate yet")
            continue
        solved_lines = now[name].outcome.revisions.items()
        pairs = (f"{n} {solved.num_lines} of {now[n].lines}" for n, solved in solved_lines)
        failed = " (a later solve has failed)" if now[name].failure else ""
        print(f"{second:4}  {name:4}  {', '.join(pairs)}{failed}")

# %% [markdown]
# At second 83 Anna has been gone for three seconds, but nobody has waited for the five seconds of
# `patience` yet. A certificate is a statement about a moment in the past. It cannot become false, since
# it speaks of edges that were measured by then, but it can become old. Anna can tell that hers is old:
# it has 32 of her lines, and she has 38. What she cannot know is the other second numbers of her row,
# that is, what the others have measured since; for that they would have to tell her. This is not a flaw
# of the method: from inside, a robot cannot distinguish between others that have stopped and a network
# that has.
#
# The proof has limits, too. It takes every edge at its word: a wrong closure raises the cost, and the
# best map of wrong edges is certified like any other (see [notebook 9](09_wrong_edges.ipynb)).

# %% [markdown]
# ## Exercises
#
# **1.** Let Dora be out of reach instead of Anna. Who drives, and is the sum of the two bounds at
# second 140 still below the least cost of all?
#
# <details><summary>Answer</summary>
#
# Anna drives her part all the time, as her name comes first, and Dora, who is alone, drives hers. Any
# two groups without a common robot will do for the sum.
#
# ```python
# without_dora = mission(new_team(), ("dora", 80, 140))
# outcomes = [without_dora[139][name].outcome for name in ("anna", "dora")]
# assert [outcome.term.driver for outcome in outcomes] == ["anna", "dora"]
# assert [outcome.covered for outcome in outcomes] == [("anna", "ben", "carl"), ("dora",)]
# assert sum(outcome.solution.lower_bound for outcome in outcomes) < optima[13]
# ```
#
# </details>
#
# **2.** Let three of ten messages be lost on the way, and nobody be out of reach. Does the last
# certificate change?
#
# <details><summary>Answer</summary>
#
# No. What is not answered within a second is sent again, so the outcome is the same, to rounding. It
# only comes later.
#
# ```python
# losing = new_team(solvers.Sharing.MEASUREMENTS)
# log_with_losses = mission(losing, ("nobody", 0, 0), lost=0.3)
# ending = log_with_losses[-1]["ben"].outcome
# assert ending.covered == tuple(names)
# assert np.isclose(ending.solution.lower_bound, optima[-1], rtol=1e-9)
# ```
#
# </details>
#
# **3.** Give the robots a patience of 100 seconds. What do Ben and Anna know at second 130?
#
# <details><summary>Answer</summary>
#
# Nothing new since second 80: everybody waits for everybody. Their certificate still covers all four
# robots, and its bound is the one of second 80. It remains a bound of all, as measurements have only
# been added. Short patience means more greetings and more solves, long patience means older maps.
#
# ```python
# patient = mission(new_team(patience=100.0), AWAY, seconds=130)
# for name in ("anna", "ben"):
#     outcome = patient[-1][name].outcome
#     assert outcome.covered == tuple(names)
#     assert np.isclose(outcome.solution.lower_bound, optima[7], rtol=1e-9)
#     assert outcome.solution.lower_bound < optima[12]
# ```
#
# </details>

# %% [markdown]
# ## Checks of the numbers above
#
# They hold for the parameters as they stand. A reader who has changed some may skip this cell.

# %%
with NamedNumbers():
    assert all(known.outcome.covered != tuple(names) for known in log[39].values())
    assert log[39]["ben"].outcome.covered == ("anna", "ben", "carl")
    for second in range(10, 181, 10):
        for name, known in log[second - 1].items():
            assert name in known.outcome.covered
            assert known.outcome.solution.is_certified
            assert not known.failure
    for second in (*range(50, 81, 10), *range(150, 181, 10)):
        for known in log[second - 1].values():
            assert known.outcome.covered == tuple(names)
            assert np.isclose(bound_of(known), optima[second // 10 - 1], rtol=1e-9)
    for second in (110, 120, 130, 140):
        assert log[second - 1]["anna"].outcome.covered == ("anna",)
        for name in names[1:]:
            assert log[second - 1][name].outcome.covered == ("ben", "carl", "dora")
            assert log[second - 1][name].outcome.term.driver == "ben"
    for second in (90, 100):
        covered = {name: log[second - 1][name].outcome.covered for name in names}
        assert covered["anna"] == ("anna",)
        assert covered["ben"] == covered["carl"] == ("ben", "carl")
        assert covered["dora"] == ("dora",)
    assert len(without_anna.components()) == 2
    assert error_of(log[-1], names) < 0.2 < error_of(log[79], names)
    assert np.isclose(bound_of_others, one_machine.objective, rtol=1e-9)
    assert bound_of_others <= one_machine.objective
    assert num_named == 5
    assert all(together < optimum for _, together, optimum in sums)
    assert [len(groups) for groups, _, _ in sums] == [3] * 2 + [2] * 4
    assert least > 0
    assert not S[np.ix_(rows_of(interiors[0]), rows_of(interiors[1]))].any()
    assert np.isclose(by_hand, team_bound, rtol=1e-9)
    assert log[89]["ben"].outcome.term.driver == "ben"
    assert log[109]["ben"].outcome.term.driver == "ben"
    assert with_stranger["ben"].covered == ("anna", "ben", "carl")
    assert with_stranger["ben"].absent == ("dora",)
    assert with_stranger["dora"].covered == ("dora",)
    assert with_stranger["ben"].ledger.dropped > 100
    assert log[82]["ben"].outcome.covered == log[82]["anna"].outcome.covered == tuple(names)
    assert log[82]["anna"].outcome.revisions["anna"].num_lines == 32
    assert log[82]["anna"].lines == 38
