# %% [markdown]
# # 14. Is it really the best?
#
# Open with `jupyter lab notebooks/14_is_it_really_the_best.ipynb`;
# `pip install -e '.[notebooks,fast]'` installs it.
#
# * **Prerequisites:** a pose graph and an answer to it, and the first three sections of
#   [notebook 1](01_quickstart.ipynb); no optimisation
# * **Time:** 15 minutes
# * **Next:** [notebook 15](15_rotation_averaging.ipynb), rotations without translations
#
# Some program has returned poses for your measurements, and it says that it has converged. Could
# there be better poses? This notebook shows an answer that passes every test one can think of and
# is wrong, how a *lower bound* settles the question, how somebody else can check it without trusting
# you, and what is left to say where the bound does not reach the answer.

# %%
import json
import tempfile
from pathlib import Path

import numpy as np
from drawings.checks import NamedNumbers
from drawings.is_it_really_the_best import film_of_multipliers, film_of_the_way

import pgo_models as pgo
import solvers
from pgo_models.graphs.scenes import NoiseModel
from solvers.studies.tightness import SweptScene, noisy_scene

# %% [markdown]
# ## An answer that passes every test
#
# A robot has walked through a small town, 60 poses in the plane. It has measured
# every step, with an error of 10 cm and 17 degrees, and it has recognised a few places. The poses are
# first composed from the steps alone and then improved by Newton's method until nothing changes
# any more.

# %%
noise = NoiseModel(translation_std=0.1, rotation_std=0.3)
rng = np.random.default_rng(8)
town = pgo.grid_world(1, 60, rng, d=2, noise=noise, loop_closure_probability=0.06)
problem = pgo.PGOProblem(town)
answer = solvers.polish(problem, pgo.odometry_start(town)).aligned_to(town.truth)
print(f"{town.num_edges} measurements")
pgo.compare_poses(town, [("the answer", answer)])

# %% [markdown]
# The *cost* $F$ of an answer adds up how strongly it contradicts every measurement: squared
# distances between what was measured and what the poses say, each with the weight that the
# measurement deserves (notebook 1 has the formula). Less is better, and zero would be no contradiction
# at all. So the question "is it the best?" means "do any other poses have a smaller $F$?".
#
# Here are the usual tests. Is the gradient of $F$ zero, so that no direction leads downhill? Do
# small changes of the poses increase the cost? Does the method return to the same answer if it is
# disturbed? Is the cost at least as low as that of the true poses?


# %%
def disturbed(poses, size, rng):
    turns = pgo.exp_map(rng.normal(0.0, size, (town.num_poses, 1)))
    return problem.with_best_translations(poses.R @ turns)


rng = np.random.default_rng(0)
cost_of_answer = problem.objective(answer)
gradient = np.concatenate([part.ravel() for part in problem.riemannian_gradient(answer)])
changes = [problem.objective(disturbed(answer, 0.05, rng)) for _ in range(500)]
neighbours = [disturbed(answer, 0.15, rng) for _ in range(20)]
returns = [problem.objective(solvers.polish(problem, poses)) for poses in neighbours]
print(f"cost of the answer                {cost_of_answer:.4f}")
print(f"largest entry of the gradient     {np.abs(gradient).max():.0e}")
print(f"500 small changes cost at least   {min(changes):.4f}")
print(f"20 runs from disturbed poses give {min(returns):.4f} to {max(returns):.4f}")
print(f"cost of the true poses            {problem.objective(town.truth):.4f}")

# %% [markdown]
# The answer passes all of them, and it looks like a town. Yet there are poses that cost less than half.
# Each of these tests looks at poses *near* the answer, or at one set of poses elsewhere. No
# number of such tests can speak of **all** poses.
#
# ## What a lower bound is
#
# A *lower bound* is a number $b$ of which one can prove that no poses at all have $F < b$. It
# settles the question from the other side. If somebody hands you an answer with $F = 100$ and a
# proof that nothing costs less than $99.99$, then nobody will ever improve the answer by more than one
# part in ten thousand, whatever they try. It does not matter how the answer was found.
#
# How can one say something about all poses without trying them? Take the smallest example: two
# poses, of which the first is held, and three measurements of the angle $\theta$ by which the second
# is turned. They contradict each other: 20, 75 and 150 degrees, and the second counts twice. A
# direction is a point on the unit circle, $z = (\cos \theta, \sin \theta)$, a measurement is such a
# point $z_k$, and the cost is, with $w_k = 2 \kappa_k$,
#
# $$F = \sum_k w_k \lVert z - z_k \rVert^2 .$$

# %%
angles = np.deg2rad([20.0, 75.0, 150.0])
kappa = np.array([1.0, 2.0, 1.0])
w = 2 * kappa
measured = np.column_stack([np.cos(angles), np.sin(angles)])


def cost(theta):
    z = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    return sum(w[k] * np.sum((z - measured[k]) ** 2, axis=-1) for k in range(3))


# %% [markdown]
# **First idea: allow more.** If $z$ may be *any* point of the plane, the cheapest one is known to
# everybody, the weighted mean of the measured points. What it costs is a lower bound, for the circle
# is a part of the plane: if no point of the plane is cheaper, no point of the circle is. But the mean
# of points on a circle is inside the circle. It is no answer, and the bound is too low.
#
# **Second idea: make it expensive to leave the circle.** Choose any number $\lambda$, the
# *multiplier*, and add $\lambda (1 - \lVert z \rVert^2)$ to the cost. On the circle this is zero, so
# that no answer changes its cost. Inside, it is a surcharge. The sum is still a quadratic function,
# with $W = \sum w_k$ and $m = \sum w_k z_k$:
#
# $$F + \lambda (1 - \lVert z \rVert^2) = (W - \lambda) \lVert z \rVert^2 - 2 m \cdot z + W + \lambda .$$
#
# If $\lambda < W$, it has its minimum over the whole plane at $z = m / (W - \lambda)$, and this
# minimum is again a lower bound on the cost of every answer:
#
# $$b(\lambda) = W + \lambda - \frac{\lVert m \rVert^2}{W - \lambda} .$$


# %%
W, m = w.sum(), w @ measured


def bound(lam):
    """The bound, and the point of the plane that is cheapest with this multiplier."""
    if lam >= W:
        return -np.inf, None  # the cost falls without end: nothing is proved
    return W + lam - m @ m / (W - lam), m / (W - lam)


best_lambda = W - np.linalg.norm(m)  # moves the cheapest point onto the circle
tried = [-4.0, -3.0, -2.0, -1.0, 0.0, 0.5, 1.0, 1.5, 2.0, best_lambda, 2.6, 3.0, 3.5, 4.0, 4.5]
bounds = np.array([bound(lam)[0] for lam in tried])
points = np.array([bound(lam)[1] for lam in tried])
least = min(cost(np.deg2rad(np.arange(0.0, 360.0, 0.01))))
print(f"least cost of all angles {least:.6f}")
print(f"bound of the plane       {bound(0.0)[0]:.6f}  (lambda = 0)")
print(f"best bound               {bound(best_lambda)[0]:.6f}  (lambda = {best_lambda:.4f})")

# %% [markdown]
# Move the slider. Every $\lambda$ gives a valid bound: the orange line never cuts the blue curve. At the
# best one it touches the curve. The cheapest point of the *whole plane* is then a point of the
# circle, so it is an answer, its cost is the bound, and the question is settled. With a still larger
# $\lambda$ the point leaves the circle on the other side, and the bound falls again.
# ([`drawings/is_it_really_the_best.py`](drawings/is_it_really_the_best.py) draws both films of this
# notebook.)

# %%
film_of_multipliers(angles, kappa, cost, tried, points, bounds)

# %% [markdown]
# ## The library agrees
#
# For a graph there is a multiplier $\Lambda_i$ for every pose, a small symmetric matrix. Whether the
# quadratic function has a minimum, here $\lambda < W$, is decided by a factorisation of a large sparse
# matrix, and one solution of a linear system gives the bound: notebook 1 does it by hand.
# `pgo.prove_bound` takes any multipliers, `solve` finds the best ones.

# %%
two_poses = pgo.PGOProblem(
    pgo.PoseGraph(
        num_poses=2,
        i=np.zeros(3, dtype=int),
        j=np.ones(3, dtype=int),
        R_ij=pgo.exp_map(angles[:, None]),
        t_ij=np.zeros((3, 2)),
        kappa=kappa,
        tau=np.zeros(3),  # only angles are measured
        name="two poses",
    )
)
of_two = solvers.solve(two_poses)
by_library = [
    pgo.prove_bound(two_poses, np.stack(2 * [lam / 2 * np.eye(2)]), poses=of_two.poses)
    for lam in tried
]
print(f"largest difference of the {len(tried)} bounds: {np.abs(by_library - bounds).max():.0e}")
print(f"multiplier that `solve` found: {2 * of_two.certificate.Lambda[1, 0, 0]:.4f}")

# %% [markdown]
# ## Back to the town
#
# `solvers.certify` takes poses from anywhere and proves a bound. Read its *gap*: the largest share of
# the cost that any other poses could save.

# %%
certificate = solvers.certify(problem, answer)
certificate

# %% [markdown]
# The gap is 0.57: the bound leaves room for poses that cost 57 % less. This alone does not prove that such
# poses exist. But `certify` also names the best cost that it knows, and `solve`, which begins at another
# start, finds these poses and proves that they are the best.

# %%
best = solvers.solve(problem)
best

# %% [markdown]
# Why did no test see it? Here is the way from the answer to the best poses, every pose turned by the
# same share of what is missing. Move the slider: the cost first *rises*, to more than the answer
# costs, and only then falls far below. The red bar is the distance between the cost and the bound. A
# method that only walks downhill does not leave the first valley.

# %%
best_poses = best.poses.aligned_to(answer)
missing = pgo.log_map(np.swapaxes(answer.R, 1, 2) @ best_poses.R)
shares = np.linspace(0.0, 1.0, 13)
on_the_way = [
    problem.with_best_translations(answer.R @ pgo.exp_map(share * missing)) for share in shares
]
costs = np.array([problem.objective(poses) for poses in on_the_way])
film_of_the_way(town, on_the_way, shares, costs, best.lower_bound)

# %% [markdown]
# ## A proof for somebody else
#
# "The program says that it is certified" is no argument for somebody who does not trust the
# program. A proof file is. `save_proof` writes the poses, a multiplier for each, and what is claimed.

# %%
folder = Path(tempfile.mkdtemp())
pgo.write_g2o(town, folder / "town.g2o")
best.save_proof(folder / "proof.json")
proof = json.loads((folder / "proof.json").read_text())
print({name: value for name, value in proof.items() if name != "poses"})
print(proof["poses"][30])

# %% [markdown]
# `pgo.verify_proof` reads the measurements and the proof, and computes the bound anew. It shares no code
# with what found the proof. It reads every number as the rational number that its digits denote, and
# completes the square pose by pose in *ball arithmetic*, where every number carries a bound on its
# rounding error. The command line does the same: `pgo verify town.g2o proof.json`.

# %%
verified = pgo.verify_proof(folder / "town.g2o", folder / "proof.json")
for label, text in verified.facts()[1:]:
    print(f"{label:12}", text)

# %% [markdown]
# What if somebody changes the proof? We try five ways.
#
# * The multipliers are made smaller by a tenth.
# * The same, and the claim is made smaller, too.
# * The claim is raised by a thousandth, to look better than it is.
# * The poses are said to cost less than they do.
# * Somebody keeps the proof and changes one measurement of the graph by 1 cm.


# %%
def verify(graph="town.g2o", shrink=1.0, **claims):
    changed = proof | claims
    changed["poses"] = [
        pose | {"Lambda": [shrink * number for number in pose["Lambda"]]} for pose in proof["poses"]
    ]
    (folder / "changed.json").write_text(json.dumps(changed))
    return pgo.verify_proof(folder / graph, folder / "changed.json")


lines = (folder / "town.g2o").read_text().splitlines()
closure = next(k for k, line in enumerate(lines) if line.startswith("EDGE")) + 65
fields = lines[closure].split()
fields[3] = str(float(fields[3]) + 0.01)  # x of the 66th measurement
lines[closure] = " ".join(fields)
(folder / "changed.g2o").write_text("\n".join(lines) + "\n")
attempts = {
    "smaller multipliers": verify(shrink=0.9),
    "and a smaller claim": verify(shrink=0.9, lower_bound=49.9),
    "a higher claim": verify(lower_bound=1.001 * proof["lower_bound"]),
    "a lower cost": verify(objective=0.9 * proof["objective"]),
    "another measurement": verify(graph="changed.g2o"),
}
for name, result in attempts.items():
    print(f"{name:20} F {float(result.objective):.4f}, bound {float(result.bound):.4f}")
    print(f"{'':20} {result.verdict}")

# %% [markdown]
# The verifier believes nothing in the file. Smaller multipliers prove a smaller bound, as in the film
# with the slider, and that bound is *also* true: with a claim to match, the changed proof is verified,
# and it proves less. Nobody can get a number verified that is not proved. Of the changed graph it says
# that the poses do not cost there what the file claims, and it prints the bound that these multipliers
# prove of the changed measurements. That bound is slightly below the new cost, for the poses and
# multipliers are those of another graph.
#
# ## Where it fails: the bound does not reach the answer
#
# The bound of two poses always touches the curve. For a graph it does as long as the noise is not too
# strong. Beyond, the cheapest point of the larger space is no set of rotations, whatever the
# multipliers, and a gap remains even for the best poses. One says that the relaxation is *loose*.
# These are two of the paper's networks in space with far more rotation noise than its 30 degrees. They
# are solved first by the plain bound alone, then as `solve` does it by itself.

# %%
loose = {
    "circle, 70 degrees": noisy_scene(SweptScene.CIRCLE, np.deg2rad(70), np.random.default_rng(0)),
    "grid, 80 degrees": noisy_scene(SweptScene.GRID, np.deg2rad(80), np.random.default_rng(0)),
}
plain = {
    name: solvers.solve(graph, solvers.Pipeline(handedness=None)) for name, graph in loose.items()
}
full = {name: solvers.solve(graph) for name, graph in loose.items()}
for name in loose:
    for how, solved in (("plain bound", plain[name]), ("solve", full[name])):
        print(
            f"{name:19} {how:12} F {solved.objective:.4f}, bound {solved.lower_bound:.4f},"
            f" gap {solved.gap:.1e}, {solved.verdict.name}"
        )

# %% [markdown]
# With the plain bound both are `NOT_CERTIFIED`. This word means: *the bound is valid, and it does not come
# as close to the cost as you asked for.* It does not mean that the answer is wrong, and it does not mean
# that it is right. Here are both cases.
#
# * **The circle's** poses were optimal all along, only the bound was too low. `solve` adds *handedness
#   terms*, which tell rotations from reflections ([notebook 16](16_beyond_the_relaxation.ipynb) explains them), and the gap closes.
# * **The grid's** poses were not optimal. On its way to a better bound `solve` came upon poses that cost
#   less, and took them. Its bound is much better than the plain one, and a gap of 0.6 % remains.
#
# What can be done with a gap that remains?
#
# * Use it. "No other poses are better by more than 0.6 %" is a proven statement, and it may be all
#   that you need.
# * Let `solve` do its work: the staircase and the handedness terms are stages that it adds by itself
#   when the certificate is open. In the plane handedness terms have nothing to add.
# * Look for wrong measurements. A few false loop closures make the same kind of gap as strong noise, and
#   they can be found ([notebook 9](09_wrong_edges.ipynb)).
# * Measure more. Additional measurements between the poses usually tighten the relaxation: the circle has 12 from
#   every pose, the grid 4 on average.
# * Restart only in the hope of better poses. In the town another start found them, and with them the
#   multipliers of a sharp bound. Where the relaxation is loose, no start closes the gap of this bound.

# %% [markdown]
# ## Exercises
#
# **1.** A colleague's answer costs 102, and your proven bound is 100. He says that it is the best answer,
# because he has tried 1000 starts. What can you say, and what not?
#
# <details><summary>Answer</summary>
#
# No answer saves more than the gap, $(102 - 100) / 102$, just under 2 %. Whether one exists that saves
# anything is open: the bound may be loose or the answer may not be the best. The 1000 starts do not
# enter.
#
# ```python
# gap = (102 - 100) / 102
# assert 0.019 < gap < 0.02
# ```
#
# </details>
#
# **2.** Let the two poses have two measurements of opposite directions, 0 and 180 degrees, with the same
# weight. What do the curve $F(\theta)$ and the best bound look like?
#
# <details><summary>Answer</summary>
#
# Every angle has the same cost, $w (2 - 2 \cos \theta) + w (2 + 2 \cos \theta) = 4 w = 2 W$: the curve is a
# horizontal line, and all angles are best answers. The measured points cancel, $m = 0$, so that
# $b(\lambda) = W + \lambda$, which rises to $2 W$ as $\lambda$ approaches $W$.
#
# ```python
# theta = np.linspace(0.0, 2 * np.pi, 100)
# opposite = 2 * (2 - 2 * np.cos(theta)) + 2 * (2 + 2 * np.cos(theta))  # w = 2, W = 4
# assert np.allclose(opposite, 8.0)
# bounds_of_opposite = 4.0 + np.array([0.0, 2.0, 3.0, 3.999])
# assert all(bounds_of_opposite <= 8.0) and bounds_of_opposite[-1] > 7.99
# ```
#
# </details>
#
# **3.** The bound of the town is one number for all answers. Use it, without any further certificate, to
# judge the true poses and the initial estimate of the town.
#
# <details><summary>Answer</summary>
#
# The gap is $(F - b) / F$ with the same $b$. The true poses have a large gap as well: they do not fit the
# noise.
#
# ```python
# gaps = [1 - best.lower_bound / problem.objective(poses) for poses in (town.truth, town.initial)]
# assert gaps[0] > 0.7
# assert gaps[1] > gaps[0]
# ```
#
# </details>

# %% [markdown]
# ## Checks of the numbers above
#
# This cell is for the tests of the library; if you have changed parameters, you may skip it.

# %%
with NamedNumbers():
    assert np.abs(gradient).max() < 1e-4
    assert min(changes) > cost_of_answer
    assert np.allclose(returns, cost_of_answer, rtol=1e-9, atol=0)
    assert best.objective < 0.5 * cost_of_answer < 0.5 * problem.objective(town.truth)
    assert best.is_certified
    assert 0.55 < certificate.gap < 0.6
    assert certificate.verdict is pgo.Verdict.NOT_CERTIFIED
    assert np.isclose(bound(best_lambda)[0], least, rtol=1e-7, atol=0)
    assert all(bounds <= least + 1e-12)
    assert np.isclose(np.linalg.norm(bound(best_lambda)[1]), 1.0)
    assert bound(W)[0] == -np.inf
    assert np.allclose(by_library, bounds, rtol=0, atol=1e-7)
    assert all(np.array(by_library) <= bounds + 1e-12)
    assert np.isclose(2 * of_two.certificate.Lambda[1, 0, 0], best_lambda, rtol=1e-6, atol=0)
    assert of_two.is_certified
    assert costs.max() > 1.5 * costs[0]
    assert np.isclose(costs[-1], best.objective)
    assert verified.is_verified
    assert float(verified.gap) < 1e-10
    assert [result.is_verified for result in attempts.values()] == [
        False,
        True,
        False,
        False,
        False,
    ]
    assert float(attempts["and a smaller claim"].bound) < best.lower_bound
    assert float(attempts["another measurement"].bound) < float(
        attempts["another measurement"].objective
    )
    assert not any(solved.is_certified for solved in plain.values())
    assert full["circle, 70 degrees"].is_certified
    assert np.isclose(
        full["circle, 70 degrees"].objective, plain["circle, 70 degrees"].objective, rtol=1e-9
    )
    assert not full["grid, 80 degrees"].is_certified
    assert full["grid, 80 degrees"].objective < plain["grid, 80 degrees"].objective - 1
    assert full["grid, 80 degrees"].gap < 0.01 < plain["grid, 80 degrees"].gap
