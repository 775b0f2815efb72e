# %% [markdown]
# # 8. You have a pose graph, and perhaps a solution: what now?
#
# Open with `jupyter lab notebooks/08_your_own_graph.ipynb`; `pip install -e '.[notebooks,fast]'`
# installs it.
#
# **Prerequisites:** [notebook 1](01_quickstart.ipynb) (a solve, a gap and its proof).
#
# **Time:** 20 minutes
#
# **Next:** [notebook 9](09_wrong_edges.ipynb), whether a wrong edge can be found
#
# This notebook starts from a `.g2o` file, as SLAM front ends write it, with landmarks, GPS and one
# wrong loop closure, and at once ends with what you would hand on: a map, its covariances, a verdict
# and a trajectory for [evo](https://github.com/MichaelGrupp/evo). The rest takes these steps one by
# one: it reads and solves a graph, judges a solution that came from elsewhere, and passes both on.
# What information matrices that are not isotropic change is the subject of
# [notebook 18](18_the_files_own_cost.ipynb).

# %%
import itertools
import tempfile
from pathlib import Path

import numpy as np
from drawings.checks import NamedNumbers

import pgo_models as pgo
import solvers
from pgo_models.graphs.datasets import places_of_edges

# %% [markdown]
# ## A graph in text
#
# Each line is a pose or a measurement. In the plane a pose is `VERTEX_SE2 id x y theta`, a
# measurement `EDGE_SE2 i j dx dy dtheta` with the upper triangle of its information matrix, the
# inverse of its covariance. (In space they are `VERTEX_SE3:QUAT` and `EDGE_SE3:QUAT`, with
# quaternions `qx qy qz qw`.) Here is a file written by hand: a robot drives three times around a
# square of 8 m, and whenever it passes a place again, it measures where it was one lap earlier.

# %%
rng = np.random.default_rng(3)
side, rounds = 8, 3
num_poses = 4 * side * rounds
heading = (np.arange(num_poses) // side) % 4 * np.pi / 2
position = np.zeros((num_poses, 2))
position[1:] = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)])[:-1], axis=0)


def measured(i, j, metres, radians):
    c, s = np.cos(heading[i]), np.sin(heading[i])
    dx, dy = np.array([[c, s], [-s, c]]) @ (position[j] - position[i]) + rng.normal(0.0, metres, 2)
    turn = heading[j] - heading[i] + rng.normal(0.0, radians)
    information = f"{metres**-2:.6g} 0 0 {metres**-2:.6g} 0 {radians**-2:.6g}"
    return f"EDGE_SE2 {i} {j} {dx:.6f} {dy:.6f} {np.arctan2(np.sin(turn), np.cos(turn)):.6f} {information}"


lines = [measured(i, i + 1, 0.05, 0.03) for i in range(num_poses - 1)]
lines += [measured(i, i + 4 * side, 0.1, 0.05) for i in range(0, num_poses - 4 * side, 3)]
folder = tempfile.TemporaryDirectory()
path = Path(folder.name) / "square.g2o"
path.write_text("\n".join(lines) + "\n", encoding="utf-8")
print(*lines[:2], lines[-1], sep="\n")

# %% [markdown]
# ## From the file to what you hand on
#
# The robot also sees four trees (`EDGE_SE2_XY pose tree x y`, in the frame of the pose), a receiver
# gives its position at ten places to half a metre (`EDGE_PRIOR_SE2_XY pose x y`, in the frame of the
# world, here 500 m further east), and one loop closure is wrong: it takes a place for a similar one.

# %%
trees = np.array([[2.0, 2.0], [6.0, 2.0], [6.0, 6.0], [2.0, 6.0]])
survey = [*lines]
for tree, place in enumerate(trees):
    for i in np.flatnonzero(np.linalg.norm(position - place, axis=1) < 2.5):
        c, s = np.cos(heading[i]), np.sin(heading[i])
        x, y = np.array([[c, s], [-s, c]]) @ (place - position[i]) + rng.normal(0.0, 0.1, 2)
        survey.append(f"EDGE_SE2_XY {i} {1000 + tree} {x:.6f} {y:.6f} 100 0 100")
for i in range(0, num_poses, 10):
    east, north = position[i] + [500.0, 0.0] + rng.normal(0.0, 0.5, 2)
    survey.append(f"EDGE_PRIOR_SE2_XY {i} {east:.6f} {north:.6f} 4 0 4")
mistaken = f"EDGE_SE2 10 {12 + 4 * side} 0.000000 0.000000 0.000000 100 0 0 100 0 400"
survey.append(mistaken)
survey_path = Path(folder.name) / "survey.g2o"
survey_path.write_text("\n".join(survey) + "\n", encoding="utf-8")

surveyed = solvers.solve(pgo.read_g2o(survey_path), robust=solvers.GNC())
print(surveyed)
(rejected,) = np.flatnonzero(surveyed.robust.rejected)
place = places_of_edges(survey_path)[rejected]
print(f"\nthe edge rejected is {place.replace(folder.name, '...')}")

# %%
surveyed.save(Path(folder.name) / "survey.tum")
blocks_of_survey = surveyed.marginals()
kept_graph = surveyed.problem.graph
in_metres = np.sqrt(np.linalg.eigvalsh(blocks_of_survey[:, :2, :2])[:, -1])
print(f"positions are known to {in_metres[:num_poses].max():.2f} m, the worst of them")
mapped = surveyed.poses.t[kept_graph.landmarks] - [500.0, 0.0]
print("trees are off by", np.linalg.norm(mapped - trees, axis=1).round(2), "m")
pgo.plot_graph(kept_graph, surveyed.poses, covariances=blocks_of_survey)

# %% [markdown]
# That is all. The summary names the wrong closure by its two poses, since a graph does not know of
# which lines it was made; `places_of_edges` reads the file again and gives the line. The verdict is
# of the edges kept, poses and trees are in the frame of the receiver with their covariances, and
# `survey.tum` is a file for evo. On the command line it is
#
#     pgo solve survey.g2o --robust gnc --out survey.tum --covariances survey.csv --report survey.html
#
# which also prints the line of each rejected edge.
#
# What follows is about each step, on the graph without trees, receiver and wrong closure.

# %% [markdown]
# ## Read it
#
# The cost $F$ of the paper's equation (16) has one number for the rotation and one for the
# translation of an edge. An information matrix becomes the precisions $\kappa$ and $\tau$
# as in SE-Sync: in the plane $\kappa = I_{\theta\theta}$,
# $\tau = 2 / \operatorname{tr}(I_{tt}^{-1})$; in space
# $\kappa = 3 / (2 \operatorname{tr}(I_{rr}^{-1}))$, $\tau = 3 / \operatorname{tr}(I_{tt}^{-1})$. In
# the plane, this $\kappa$ is twice the weight of a rotation in a Gaussian model. We begin with $F$, whose
# certificate fits on a page. Unless it is asked for $F$, `solve` minimises $\chi^2$ of the complete
# matrices ([notebook 18](18_the_files_own_cost.ipynb)).


# %%
def problem_of(graph: pgo.PoseGraph) -> pgo.PGOProblem:
    """The problem whose cost is F."""
    return pgo.PGOProblem(graph, weighting=pgo.Weighting.ISOTROPIC)


graph = pgo.read_g2o(path)
problem = problem_of(graph)
print(graph)
print(
    f"tau of a step {graph.tau[0]:.1f} = 0.05^-2 per m^2, kappa {graph.kappa[0]:.1f} = 0.03^-2 per rad^2"
)

# %% [markdown]
# A wrong file is refused with one line that names the place, the error and the remedy.

# %%
broken = Path(folder.name) / "broken.g2o"
broken.write_text("\n".join([*lines[:5], "EDGE_SE2 5 6 1.0 0.0"]) + "\n", encoding="utf-8")
message = ""
try:
    pgo.read_g2o(broken)
except pgo.PGOError as error:
    message = str(error)
print(message.replace(folder.name, "..."))

# %% [markdown]
# ## Solve it
#
# The file has no `VERTEX` lines, so there is no estimate to start from; none is needed. Composing
# the odometry, the only possibility without loop closures, drifts. Move the slider to see Newton's
# method, one of the stages of `solve`, close the three laps.

# %%
solution = solvers.solve(problem)
print(solution)
newton = solvers.Newton()
odometry = pgo.odometry_start(graph)
states = solvers.iterate(newton, problem, odometry)
iterates = [newton.poses(problem, state) for state in itertools.islice(states, 8)]
costs = [problem.objective(poses) for poses in iterates]
labels = [f"step {k}: F = {cost:.6g}" for k, cost in enumerate(costs)]
pgo.animate_poses(graph, iterates, labels)

# %% [markdown]
# ## Certify someone else's solution
#
# Somebody gives you a trajectory in a TUM file (`time x y z qx qy qz qw`). In this example it is
# the rounded chordal relaxation, from which many programs start and at which some stop. Its gap is
# a proven limit on what can still be saved, whichever program made it.

# %%
theirs_path = Path(folder.name) / "theirs.tum"
pgo.write_tum(pgo.chordal_start(problem), theirs_path)

theirs = pgo.read_tum(theirs_path, d=2)
certificate = solvers.certify(problem, theirs)
print(certificate)

# %% [markdown]
# By hand, this needs only $F$ and a proven bound:
#
# $$\text{gap} = \frac{F(\text{theirs}) - b}{F(\text{theirs})},$$
#
# and anyone can check the proof: the certificate has the multipliers $\Lambda$ and the poses where
# they were taken. With one of these poses grounded, the proof is one successful Cholesky
# factorisation of $S$ and one solve ([notebook 1](01_quickstart.ipynb)). `prove_bound` does the
# same, and subtracts all rounding errors. (Both also need $\eta$, which is 0 here; on a graph with
# a loose relaxation it is not, and then only `prove_bound` accounts for what the bound loses.)

# %%
n, d = problem.num_poses, problem.d
S = pgo.certificate_matrix(problem, certificate.Lambda).toarray()
grounded = certificate.poses.with_gauge_at(0)
kept = np.r_[1:n, n + d : n + d * n]  # all rows but those of pose 0, which is (0, I)
half = np.linalg.solve(np.linalg.cholesky(S[np.ix_(kept, kept)]), (S @ grounded.stacked())[kept])
bound = problem.objective(grounded) - np.sum(half**2)
proved = pgo.prove_bound(problem, certificate.Lambda, certificate.eta, certificate.poses)
F_theirs = problem.objective(theirs)
gap_by_hand = (F_theirs - bound) / F_theirs
print(f"bound {bound:.10f} by hand, {proved:.10f} by the library")
print(f"gap   {gap_by_hand:.10f} by hand, {certificate.gap:.10f} by the library")

# %% [markdown]
# ## Where it fails: a wrong loop closure
#
# The certificate says that no poses fit *these measurements* better. It does not say that the
# measurements are right. Add one wrong loop closure, which takes a place for a similar one 2 m
# further on: the solution is certified, and wrong.

# %%
wrong = f"EDGE_SE2 10 {12 + 4 * side} 0.000000 0.000000 0.000000 100 0 0 100 0 400"
path.write_text("\n".join([*lines, wrong]) + "\n", encoding="utf-8")
fooled = solvers.solve(problem_of(pgo.read_g2o(path)))
suspect = fooled.edge_residuals
worst = int(np.argmax(suspect.cost))
print(f"{fooled!r}; F was {solution.objective:.1f} without that edge")
times = suspect.cost[worst] / suspect.allowed[worst]
print(f"worst: {fooled.problem.graph.edge_label(worst)}, {times:.1f} times its threshold")
print("edges that cost more than they may:", np.flatnonzero(suspect.is_misfit))
print(
    f"together {suspect.overall:.2f} times what is expected; over {suspect.overall_allowed:.2f} in one graph of 100"
)
print(
    f"without it {solution.edge_residuals.overall:.2f}; over what they may:",
    solution.edge_residuals.is_misfit.sum(),
)
pgo.plot_graph(fooled.problem.graph, fooled.poses, "certified, and wrong")

# %% [markdown]
# The residuals help. Of 118 edges, one costs several times as much as errors with its information
# matrix would (the threshold is the chi-square quantile that right edges exceed in one graph of
# 100), and the picture marks it; without this edge, none exceeds the threshold. All edges together
# cost four times what is expected. This sum detects a wrong closure also where few others
# contradict it, so that the odometry deforms and no single edge stands out. But the edge with the
# largest cost need not be the wrong one: [notebook 9](09_wrong_edges.ipynb) explains why, and what can
# be done. `pgo solve square.g2o --robust gnc` looks for wrong measurements and solves without them.

# %%
truth = pgo.Poses(pgo.exp_map(heading[:, None]), position)
for name, poses in (
    ("odometry", odometry),
    ("with the wrong edge", fooled.poses),
    ("without it", solution.poses),
):
    metres, radians = pgo.relative_pose_error(poses, truth)
    print(
        f"{name:20} ATE {pgo.absolute_trajectory_error(poses, truth):.3f} m   RPE {metres:.3f} m, {radians:.3f} rad"
    )

# %% [markdown]
# ## Pass it on
#
# The suffix selects the format that `Solution.save` writes: `.g2o` for the next optimiser, TUM and
# KITTI for evo, `.json` for everything else. In the plane the trajectories are lifted to $z = 0$.

# %%
for name in ("solved.g2o", "solved.tum", "solved.kitti", "solved.json"):
    solution.save(Path(folder.name) / name)
pgo.write_tum(truth, Path(folder.name) / "truth.tum")
for name in ("solved.tum", "solved.kitti"):
    print(
        f"{name:13} {(Path(folder.name) / name).read_text(encoding='utf-8').splitlines()[1][:90]}"
    )

# %% [markdown]
# On the command line:
#
#     pgo solve square.g2o --out solved.tum --report solved.html
#     pgo certify square.g2o --estimate theirs.tum
#     evo_ape tum truth.tum solved.tum --align --plot
#
# Reading the file returns the same poses:

# %%
returned = pgo.read_tum(Path(folder.name) / "solved.tum", d=2)
again = pgo.read_g2o(Path(folder.name) / "solved.g2o")
kitti = pgo.read_kitti(Path(folder.name) / "solved.kitti", d=2)
print(
    f"F of the poses: solved {solution.objective:.9f}, TUM {problem.objective(returned):.9f}, ",
    end="",
)
print(f"KITTI {problem.objective(kitti):.9f}, g2o {problem.objective(again.initial):.9f}")

# %% [markdown]
# ## Exercises
#
# **1.** A colleague says that all sensors are twice as accurate as the file states. How do the
# poses, the covariances and the test of the edges change?
#
# <details><summary>Answer</summary>
#
# The information is four times as large. The poses do not change, the covariances are a quarter,
# and every cost is four times as large, so that some edges now fail the test.
#
# ```python
# confident = graph.with_weights(4 * graph.kappa, 4 * graph.tau)
# sure, before = solvers.solve(confident), solvers.solve(problem)
# assert np.allclose(sure.poses.t, before.poses.t, atol=1e-6)
# assert np.allclose(4 * sure.marginals()[5], before.marginals()[5], rtol=1e-6)
# assert sure.edge_residuals.overall > 3.9 * before.edge_residuals.overall
# ```
#
# </details>
#
# **2.** Rotate the whole trajectory by a degree and shift it by a kilometre. What does the
# certificate say?
#
# <details><summary>Answer</summary>
#
# The same, because $F$ does not depend on the frame.
#
# ```python
# R = pgo.exp_map(np.array([[np.deg2rad(1.0)]]))[0]
# elsewhere = pgo.Poses(R @ theirs.R, theirs.t @ R.T + 1000.0)
# assert np.isclose(solvers.certify(problem, elsewhere).gap, certificate.gap, rtol=1e-5)
# ```
#
# </details>
#
# **3.** If the only closure is wrong, can any test of residuals find it?
#
# <details><summary>Answer</summary>
#
# No. Without a second closure nothing contradicts it. The odometry deforms by as much as the
# closure requires, the deformation is spread over all its edges, and every edge stays below its
# threshold.
#
# ```python
# alone = Path(tempfile.mkdtemp()) / "alone.g2o"
# closure = f"EDGE_SE2 0 {4 * side} 1.0 0.0 0.0 100 0 0 100 0 400"
# alone.write_text("\n".join([*lines[: num_poses - 1], closure]) + "\n", encoding="utf-8")
# bent = solvers.solve(pgo.read_g2o(alone))
# alone.unlink()
# alone.parent.rmdir()
# assert bent.is_certified
# assert not bent.edge_residuals.is_misfit.any()
# ```
#
# </details>

# %% [markdown]
# ## Checks of the numbers above
#
# If you have changed the graph or the settings, these checks may fail; you may skip them.

# %%
with NamedNumbers():
    assert np.isclose(graph.tau[0], 0.05**-2, rtol=1e-5)
    assert np.isclose(graph.kappa[0], 0.03**-2, rtol=1e-5)
    assert "broken.g2o" in message
    assert "6" in message
    assert solution.is_certified
    assert certificate.eta == 0
    assert np.isclose(gap_by_hand, certificate.gap, rtol=1e-8, atol=0)
    assert np.isclose(bound, proved, rtol=1e-11, atol=0)
    assert certificate.gap > 1e-6
    assert proved <= solution.objective <= F_theirs
    assert fooled.is_certified
    assert fooled.objective > 1.5 * solution.objective
    assert worst == graph.num_edges
    assert np.flatnonzero(suspect.is_misfit).tolist() == [worst]
    assert not solution.edge_residuals.is_doubtful
    assert pgo.absolute_trajectory_error(
        solution.poses, truth
    ) < 0.8 * pgo.absolute_trajectory_error(fooled.poses, truth)
    assert np.isclose(problem.objective(returned), solution.objective, rtol=1e-9)
    assert np.isclose(problem.objective(kitti), solution.objective, rtol=1e-9)
    assert np.isclose(problem.objective(again.initial), solution.objective, rtol=1e-9)
    folder.cleanup()
    assert costs[0] > 10 * solution.objective
    assert np.isclose(costs[-1], solution.objective, rtol=1e-9)
    assert surveyed.is_certified
    assert rejected == survey.index(mistaken)
    assert place.endswith(f"survey.g2o:{len(survey)}")
    assert np.linalg.norm(mapped - trees, axis=1).max() < 0.5
