# %% [markdown]
# # 7. Where do the last few percent of the paper's tables come from?
#
# Open with `jupyter lab notebooks/07_the_papers_tables.ipynb`; `pip install -e '.[notebooks,fast]'`
# installs it.
#
# **Prerequisites:** [notebook 4](04_splitting_orthogonality.ipynb) (SOC), and
# [notebook 5](05_sdp_and_certificates.ipynb) for what a certified optimum is.
#
# **Time:** 30 minutes
#
# **For whom:** readers of the paper, and those who compare a method of their own with its tables. No
# other notebook needs this one; if you have a graph to solve, go on to notebook 8.
#
# **Next:** [notebook 8](08_your_own_graph.ipynb), what to do with a graph of your own
#
# In the paper's tables 1 and 3 SOC ends a few percent above the certified optimum: 3.9 % on the
# circle, 7.6 % on the grid, 6.0 % on the sphere (as a share of its own $F$). Is the reason too few
# iterations, a local minimum, or the model? This notebook runs the paper's experiment on its three
# networks, and then analyses the result. It begins with a page on what the tables are, and on what
# can be compared with them.

# %%
import itertools
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from drawings.checks import NamedNumbers

import pgo_models as pgo
import solvers
from pgo_models.graphs.published_results import published_rows, published_run
from solvers.studies.paper_tables import ReproductionSettings
from solvers.studies.paper_tables_text import findings

plt.rcParams["figure.dpi"] = 150
NAMES = ("circle", "grid", "sphere")


def shown(frame, **formats):
    """The frame with its numbers as text, a dash where there is none."""
    for column, form in formats.items():
        frame = frame.assign(
            **{column: [form.format(x) if pd.notna(x) else "-" for x in frame[column]]}
        )
    return frame


# %% [markdown]
# ## What the four tables are
#
# The section *Simulation results* of the paper compares three methods on seven graphs. SE-Sync is a
# central method that finds the optimum $F^*$ and certifies it. DGS (distributed Gauss-Seidel) rounds
# a relaxation and is run by robots, and SOC is the paper's own method. The tables come in pairs:
#
# | graphs | cost $F$ | iterations and time |
# |---|---|---|
# | circle, grid, sphere: simulated | table 1 | table 2 |
# | parking garage, cubicle, torus, rim: public files | table 3 | table 4 |
#
# The three scenes have known positions; true rotations are drawn at random. Every measurement has
# Gaussian noise of 0.5 m in each coordinate and of 30 degrees about each axis. Runs on the scenes
# start from simulated GPS and IMU, that is, from the truth with the same noise. Runs on the files
# start from a spanning tree. `published_rows` contains the figures, from `data/reference.json`:


# %%
def table_row(row):
    """One graph, from two of the paper's tables."""
    return {
        "poses": row.num_poses,
        "edges": row.num_edges,
        "F*": row.se_sync.objective,
        "F, DGS": row.dgs.objective,
        "F, SOC": row.soc.objective,
        "its., DGS": row.dgs.iterations,
        "its., SOC": row.soc.iterations,
        "s, SE-Sync": row.se_sync.seconds,
        "s, DGS": row.dgs.seconds,
        "s, SOC": row.soc.seconds,
    }


four_tables = pd.DataFrame({row.name: table_row(row) for row in published_rows()}).T
shown(
    four_tables,
    **dict.fromkeys(("poses", "edges", "its., DGS", "its., SOC"), "{:.0f}"),
    **dict.fromkeys(("F*", "F, DGS", "F, SOC"), "{:.8g}"),
    **dict.fromkeys(("s, SE-Sync", "s, DGS", "s, SOC"), "{:.4g}"),
)

# %% [markdown]
# A dash stands where the paper has no figure. DGS had none on the three largest graphs, where the
# paper reports trouble with its convergence, and SE-Sync has no iterations of communication.
#
# ## What was measured, and what the paper leaves open
#
# The columns of SE-Sync and DGS are quoted from an earlier work, whose experiment the paper follows
# (Cristofalo et al. 2020); the heads of the columns say so. Only the column of SOC is the paper's
# own measurement. Four things have to be known before these figures are compared, with each other
# or with ours.
#
# *The draw of the noise.* The noise of the scenes was not published. The paper does not say whether
# its SOC ran on the draw from which the quoted $F^*$ comes. If it did not, then a part of its gaps is
# the difference between two draws. How large this part can be is shown by our own draws:

# %%
full = json.loads(Path("tables.json").read_text(encoding="utf-8"))
draws = {row["graph"]: row for row in full["rows"] if row["method"] == "SE-Sync (staircase)"}
for row in published_rows()[:3]:
    own, paper = draws[row.name], row.se_sync.objective
    excess = row.soc.objective - paper
    print(
        f"{row.name:8} F* of {own['draws']} draws {own['optimum']:.1f} +- {own['optimum_std']:.1f}, "
        f"paper {paper:.1f}; its SOC is {excess:.1f} above, {excess / own['optimum_std']:.1f} deviations"
    )

# %% [markdown]
# The paper's SOC is above $F^*$ by 1.4 to 3.4 standard deviations of $F^*$ itself. On the circle and
# the grid this could be chance, if the draws were different ones. This notebook assumes that they
# were the same; with another draw the published gaps would mean nothing.
#
# *The iterations.* Those of DGS and of SOC are different things: steps of Gauss-Seidel in one case,
# turns of Algorithm 1 in the other. Whether the second stage of SOC is counted is not said. We count
# rounds of messages instead, and those of all stages.
#
# *The time.* The paper names neither its machine nor its language. The quoted times of SE-Sync are
# those of a MATLAB version; the authors of SE-Sync report 0.47 s for the parking garage with their
# own C++ program, where table 4 has 84.7 s. So the quotients of these times say little about the
# methods. Our own seconds, in the file `tables.json`, are those of Python on a machine that did other
# work, too. They compare our methods with each other at most, and this notebook does not use them.
#
# *The settings.* The first $\rho$, the tolerance and the length of the second stage are not stated,
# and the rule by which $\rho$ changes is given by a reference. The notes of `solvers.PaperSOC` list
# what had to be chosen.
#
# ## Why our numbers differ
#
# Ours are other draws of the same scenes, so that costs differ (on the grid by 13 %), and only gaps
# can be compared. On the public files there is no noise to draw, and our $F^*$ is the paper's to all
# its digits (`rim` was not available to us). Our gaps are $(F - b) / F$ with a *proven* lower bound
# $b$. The paper divides by $F^*$, so that its 6.2 % on average over the three scenes is 5.8 % in our
# unit. And our SOC ends elsewhere, which is the subject of the rest:

# %%
published = {row.name: row for row in published_rows()}
graphs = {name: pgo.load(name) for name in NAMES}
optima = {name: solvers.solve(graph) for name, graph in graphs.items()}
columns = {
    "F*, paper": [published[name].se_sync.objective for name in NAMES],
    "DGS, paper": [published[name].dgs.objective for name in NAMES],
    "SOC, paper": [published[name].soc.objective for name in NAMES],
    "gap of SOC, paper": [published_run(graphs[name]).gap for name in NAMES],
    "F*, here": [optima[name].objective for name in NAMES],
    "certified to": [optima[name].gap for name in NAMES],
}
report = pd.DataFrame(columns, index=NAMES)
one = "{:.1f}"
shown(
    report,
    **{
        "F*, paper": one,
        "DGS, paper": one,
        "SOC, paper": one,
        "gap of SOC, paper": "{:.1%}",
        "F*, here": one,
    },
    **{"certified to": "{:.0e}"},
)

# %% [markdown]
# ## Algorithm 1 by hand
#
# The algorithm has rotations only, and each pose is a robot. Every robot minimises step (a) over
# its own $R_i$ while its neighbours keep the values of the last iterate (the superscripts $k - 1$
# in Algorithm 1). With one unknown matrix the minimum has a closed form. An edge $(i, j)$ pulls
# $R_i$ to $R_j R_{ij}^\top$, an edge $(j, i)$ to $R_j R_{ji}$, so
#
# $$R_i = \frac{2 \sum_{(i,j)} \kappa_{ij} R_j R_{ij}^\top + 2 \sum_{(j,i)} \kappa_{ji} R_j R_{ji}
#   + \rho (\omega_i - B_i)}
#   {2 \sum \kappa + \rho},$$
#
# an average of the neighbours' estimates and of $\omega_i - B_i$. The initial estimate comes from
# GPS and IMU, as in the paper. Three things differ from the paper: $\rho$ is constant, the edges
# have weights, and $\omega$ is a rotation, where Algorithm 1 takes any orthogonal matrix.
# `PaperSOC` lists all differences.


# %%
def algorithm_1(graph, rho, iterations):
    R = omega = graph.initial.R
    B = np.zeros_like(R)
    kappa = graph.kappa[:, None, None]
    total = np.bincount(graph.i, graph.kappa, graph.num_poses) + np.bincount(
        graph.j, graph.kappa, graph.num_poses
    )
    for _ in range(iterations):
        pull = rho * (omega - B)
        np.add.at(pull, graph.i, 2 * kappa * R[graph.j] @ graph.R_ij.transpose(0, 2, 1))
        np.add.at(pull, graph.j, 2 * kappa * R[graph.i] @ graph.R_ij)
        R = pull / (2 * total + rho)[:, None, None]
        omega = pgo.project_to_rotations(R + B)
        B = B + R - omega
        yield omega


def gap(name, rotations):
    """F with the best translations for these rotations, over the certified optimum, minus 1."""
    problem = optima[name].problem
    return problem.objective(problem.with_best_translations(rotations)) / optima[name].objective - 1


rho = (
    20.0  # ours: the smallest of 1, 5, 10, 20 and 50 with which all three graphs settle, see below
)
by_hand = {name: list(algorithm_1(graph, rho, 150)) for name, graph in graphs.items()}

# %% [markdown]
# ## The library agrees

# %%
differences = {}
for name, graph in graphs.items():
    soc = solvers.PaperSOC(penalty=solvers.FixedPenalty(rho))
    states = itertools.islice(solvers.iterate(soc, optima[name].problem, graph.initial), 1, 151)
    pairs = zip(states, by_hand[name], strict=True)
    differences[name] = max(np.abs(state.omega - omega).max() for state, omega in pairs)
    print(f"{name:8} differs from ours by {differences[name]:.0e} in 150 iterations")

# %% [markdown]
# ## It converges, a few percent too high

# %%
curves = {name: np.array([gap(name, omega) for omega in by_hand[name]]) for name in NAMES}
adaptive, adaptive_curves = solvers.PaperSOC(), {}
for name, graph in graphs.items():
    states = itertools.islice(
        solvers.iterate(adaptive, optima[name].problem, graph.initial), 1, 151
    )
    adaptive_curves[name] = np.array([gap(name, state.omega) for state in states])

figure, axes = plt.subplots(figsize=(5.6, 3.2), layout="constrained")
for name, colour in zip(NAMES, ("#0072B2", "#E69F00", "#009E73"), strict=True):
    run = published_run(graphs[name])
    axes.semilogy(np.arange(1, 151), curves[name], color=colour, label=name)
    axes.semilogy(np.arange(1, 151), adaptive_curves[name], "--", color=colour, linewidth=0.8)
    axes.semilogy(run.iterations, run.objective / run.optimum - 1, "*", color=colour, markersize=11)
axes.set_xlabel("iteration")
axes.set_ylabel("F(omega) / F* - 1")
axes.set_title("rho = 20; dashed: adaptive rho; stars: the paper's SOC", fontsize=10)
_ = axes.legend(fontsize=8)

# %% [markdown]
# All curves become flat at 4 to 9 %, the height of the stars. The positions at which the solid
# curves pass the stars mean little: the paper states no $\rho$ and adapts it, and we chose our
# value of 20 after looking at such curves. With the library's adaptive rule (dashed) the curves
# reach the same height, but the circle and the sphere are far above it after the number of
# iterations of the paper. *How soon* depends on $\rho$; *where* does not, and that is the question
# here.
#
# So the last few percent are not a matter of iterations. Is the reason a local minimum, then?
# Compute the *certified global* optimum of what Algorithm 1 minimises, which is the rotation part
# of $F$ alone: give the translations almost no weight.

# %%
rotation_gaps = {}
for name, graph in graphs.items():
    rotations_only = pgo.PGOProblem(graph.with_weights(graph.kappa, 1e-7 * graph.tau))
    certified = solvers.solve(rotations_only)
    rotation_gaps[name] = gap(name, certified.poses.R)
    print(
        f"{name:8} best rotations by rotation measurements alone: {certified.certificate.verdict.name},"
        f" {rotation_gaps[name]:.4f} above F*; Algorithm 1: {curves[name][-1]:.4f}"
    )

# %% [markdown]
# Neither. **Algorithm 1 finds the global optimum of its own problem, and this problem differs from
# the full one by a few percent**: the translation measurements
# $t_{ij} \approx R_i^\top (t_j - t_i)$ also contain information on $R_i$, and rotations that were
# estimated without them fit them worse. The published gaps, of other draws of the noise, are of the
# same size, so on these three scenes they *may* be those of the first stage alone. This is our
# guess, not a statement of the paper, and the full table below contradicts it for the cubicle and
# the torus.
#
# There are two ways to close the gap: the second stage that the paper proposes, Gauss-Newton on the
# full poses; or step (a) over rotations and translations together from the beginning, as in
# [notebook 4](04_splitting_orthogonality.ipynb).

# %%
endings = {}
for name in NAMES:
    problem = optima[name].problem
    second = solvers.run(
        solvers.gauss_newton(), problem, problem.with_best_translations(by_hand[name][-1])
    )
    joint = solvers.run(solvers.SOC(), problem)
    endings[name] = (
        second.objective / optima[name].objective - 1,
        joint.objective / optima[name].objective - 1,
    )
    print(
        f"{name:8} Gauss-Newton after it: {endings[name][0]:8.0e} in {second.iterations} steps;"
        f" joint SOC: {endings[name][1]:8.0e} in {joint.iterations} iterations"
    )

# %% [markdown]
# ## The tables
#
# `reproduce_tables` runs the methods of the tables as the paper does. The two stages of SOC
# together get as many rounds as the paper took iterations. Here the table has two draws of each
# scene; `pgo tables` on the command line takes twenty, and the benchmark graphs.

# %%
tables = solvers.reproduce_tables(ReproductionSettings(only=NAMES, num_seeds=2), progress=False)
records = [
    {
        "graph": row.published.name,
        "method": row.contender.label,
        "gap": np.mean([cell.gap for cell in row.cells]),
        "gap, paper": row.published_gap,
        "rounds": np.mean(
            [cell.rounds for cell in row.cells if cell.rounds is not None] or [np.nan]
        ),
    }
    for row in tables.rows
]
two_draws = pd.DataFrame(records).set_index(["graph", "method"])
shown(two_draws, **{"gap": "{:.1e}", "gap, paper": "{:.1%}", "rounds": "{:.0f}"})

# %%
for finding in findings(tables):
    print(finding)

# %% [markdown]
# ## The full table
#
# The cubicle and the torus take longer than a notebook should. Their figures are in `tables.json`
# beside this notebook, made by
#
#     PGO_DATA=folder-with-the-graphs pgo tables --out notebooks/tables.json
#
# For a row without figures, `remark` in the file gives the reason: `rim` was not available when the
# file was made.

# %%
table = pd.DataFrame(full["rows"])
figures = [
    "objective",
    "gap",
    "gap_after_first_stage",
    "paper_objective",
    "paper_gap",
    "rounds",
    "paper_iterations",
]
shown(
    table.set_index(["graph", "method"])[figures],
    **dict.fromkeys(("objective", "paper_objective"), "{:.6g}"),
    **dict.fromkeys(("gap", "gap_after_first_stage"), "{:.1e}"),
    **dict.fromkeys(("rounds", "paper_iterations"), "{:.0f}"),
    paper_gap="{:.1%}",
)

# %% [markdown]
# Compare like with like. Within the paper's iterations `SOC as in the paper` ends far below the
# paper's $F$, but Gauss-Newton reaches this value, in the rounds that the first stage leaves, and
# the paper does not state how long it runs its own Gauss-Newton. After SOC alone (its own column,
# as a gap; at most half of the rounds) our figures are below the paper's on the grid, the sphere
# and the garage, and *above* them on the circle, the cubicle and the torus. On the last two graphs,
# the reason is not the number of rounds. As on the scenes above, the rotations alone have a
# certified optimum, and its $F$, with the best translations, is above the paper's 724.56 and
# 24449.94:

# %%
reference = json.loads(Path("../data/reference.json").read_text(encoding="utf-8"))[
    "rotations_only_optimum"
]
for name in ("cubicle", "torus3D"):
    theirs = published[name].soc.objective
    print(
        f"{name:8} certified optimum of the rotations alone: F = {reference[name]}; paper: {theirs}"
    )

# %% [markdown]
# So these figures cannot be the end of a first stage that finds the optimum of its own problem. The
# paper does not say what they are.

# %% [markdown]
# ## Where it fails
#
# The paper's coupling has a price: since a robot keeps its neighbours fixed, it uses their old
# rotations. With too small a $\rho$ the run never converges, as in
# [notebook 4](04_splitting_orthogonality.ipynb), but here $\rho$ has to be larger. And information
# travels only one edge per iteration: on the torus, 1587 iterations are not enough for residuals of
# 1e-5.

# %%
never = {name: list(algorithm_1(graph, 1.0, 150))[-1] for name, graph in graphs.items()}
for name in NAMES:
    ends = {
        value: gap(name, list(algorithm_1(graphs[name], value, 150))[-1])
        for value in (1.0, 5.0, 10.0, 20.0, 50.0)
    }
    print(
        f"{name:8} above F* after 150 iterations:",
        *(f"rho {value:g}: {end:.3f} " for value, end in ends.items()),
    )

# %% [markdown]
# ## Exercises
#
# **1.** Does the height at which Algorithm 1 ends depend on $\rho$? Run it with 50 for longer.
#
# <details><summary>Answer</summary>
#
# No. The height is that of the best rotations by rotation measurements alone, which does not depend
# on $\rho$. Only the number of iterations does.
#
# ```python
# later = list(algorithm_1(graphs["grid"], 50.0, 600))[-1]
# assert abs(gap("grid", later) - rotation_gaps["grid"]) < 1e-3
# ```
#
# </details>
#
# **2.** Split $F$ into its rotation and its translation part, at the end of Algorithm 1 and at the
# optimum. Which of the two is worse in which part?
#
# <details><summary>Answer</summary>
#
# Algorithm 1 fits the rotation measurements better than the optimum does, and the translation
# measurements worse; the loss is larger than the gain.
#
# ```python
# def parts(name, poses):
#     own = graphs[name]
#     R_i, R_j = poses.R[own.i], poses.R[own.j]
#     return np.sum(own.kappa * np.sum((R_j - R_i @ own.R_ij) ** 2, axis=(1, 2))), optima[name].problem.objective(poses)
#
# first_stage = optima["sphere"].problem.with_best_translations(by_hand["sphere"][-1])
# rotation_first, all_first = parts("sphere", first_stage)
# rotation_best, all_best = parts("sphere", optima["sphere"].poses)
# assert rotation_first < rotation_best
# assert all_first - rotation_first > all_best - rotation_best
# ```
#
# </details>
#
# **3.** From the frame `table`: in which rows of SOC as in the paper do the first stage's rotations
# alone end above the gap of the paper?
#
# <details><summary>Answer</summary>
#
# One line of pandas: the circle, the cubicle and the torus.
#
# ```python
# soc_rows = table[table["method"] == "SOC as in the paper"].set_index("graph")
# above = soc_rows[soc_rows["gap_after_first_stage"] > soc_rows["paper_gap"]].index
# assert set(above) == {"circle", "cubicle", "torus3D"}
# ```
#
# </details>

# %% [markdown]
# ## Checks of the numbers above
#
# If you have changed seeds or settings, these checks may fail; you may skip them.

# %%
with NamedNumbers():
    assert all(difference < 1e-9 for difference in differences.values())
    for name in NAMES:
        run = published_run(graphs[name])
        assert optima[name].is_certified
        assert 0.02 < curves[name][-1] < 0.12
        assert abs(curves[name][-1] - rotation_gaps[name]) < 1e-3
        assert abs(adaptive_curves[name][-1] - rotation_gaps[name]) < 1e-3
        assert all(abs(ending) < 1e-5 for ending in endings[name])
        assert gap(name, never[name]) > 1.5 * curves[name][-1]
    assert not any(finding.failed for finding in findings(tables))
    for row in published_rows()[:3]:
        excess = row.soc.objective - row.se_sync.objective
        assert 1.0 < excess / draws[row.name]["optimum_std"] < 4.0
    for name in ("parking-garage", "cubicle", "torus3D"):
        assert np.isclose(draws[name]["optimum"], published[name].se_sync.objective, rtol=5e-4)
    by_name = {(row["graph"], row["method"]): row for row in full["rows"]}
    for name in ("parking-garage", "cubicle", "torus3D"):
        soc = by_name[name, "SOC as in the paper"]
        assert soc["objective"] < soc["paper_objective"]
        assert soc["rounds"] <= soc["paper_iterations"]
    for name in ("cubicle", "torus3D"):
        soc = by_name[name, "SOC as in the paper"]
        assert soc["gap_after_first_stage"] > soc["paper_gap"]
        assert reference[name] > soc["paper_objective"]
