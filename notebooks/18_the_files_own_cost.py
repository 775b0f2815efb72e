# %% [markdown]
# # 18. Can the file's own cost be certified, too?
#
# Open with `jupyter lab notebooks/18_the_files_own_cost.ipynb`; `pip install -e '.[notebooks,fast]'`
# installs it.
#
# - **Prerequisites:** [notebook 1](01_quickstart.ipynb) (a solve, a gap and its proof), and
#   [notebook 8](08_your_own_graph.ipynb) for the lines of a g2o file; the covariance of a Gaussian.
# - **Time:** 15 minutes
# - **Next:** this was the last one; the [guide](site/guide/index.md) has a page for each task
#
# The certificate of notebook 1 is one of the paper's cost $F$, which is quadratic in rotations and
# translations, because it has one number for the rotation and one for the translation of an edge. The
# edges of a file have whole information matrices, and their cost is not quadratic. This notebook shows
# what is lost if $F$ is minimised in its place, and how a quadratic function that touches the file's
# own cost from below certifies that cost.

# %%
from dataclasses import replace

import numpy as np
from drawings.checks import NamedNumbers

import pgo_models as pgo
import solvers
from pgo_models.graphs.scenes import NoiseModel

# %% [markdown]
# ## A camera that sees depth badly
#
# A robot drives through a small town in the plane. It measures its steps to 5 cm and 2 degrees. It
# recognises places with a camera whose errors are 10 cm sideways and 1 m in depth, and 3 degrees. We
# draw such errors for the loop closures, and write their information matrices, the inverses of the
# covariances.

# %%
rng = np.random.default_rng(3)
exact = NoiseModel(translation_std=0.05, rotation_std=np.deg2rad(2.0))
town = pgo.grid_world(1, 120, rng, d=2, noise=exact, loop_closure_probability=0.3)
is_closure = np.abs(town.j - town.i) > 1
stds = np.where(is_closure[:, None], [1.0, 0.1, np.deg2rad(3.0)], [0.05, 0.05, np.deg2rad(2.0)])
R_true = np.swapaxes(town.truth.R[town.i], 1, 2) @ town.truth.R[town.j]
moved = town.truth.t[town.j] - town.truth.t[town.i]
t_true = np.einsum("eba,eb->ea", town.truth.R[town.i], moved)
errors = stds * rng.standard_normal(stds.shape)
seen = replace(
    town,
    R_ij=R_true @ pgo.exp_map(errors[:, 2:]),
    t_ij=t_true + np.einsum("eab,eb->ea", R_true, errors[:, :2]),
    kappa=stds[:, 2] ** -2.0,  # of F; see below
    tau=2 / np.sum(stds[:, :2] ** 2, axis=1),
    information=np.array([np.diag(std**-2.0) for std in stds]),
    name="camera",
)
print(f"{seen.num_poses} poses, {seen.num_edges} edges, {is_closure.sum()} of them closures")

# %% [markdown]
# ## Two costs, two optima
#
# $F$ replaces an information matrix by two numbers; in the plane they are
# $\kappa = I_{\theta\theta}$ and $\tau = 2 / \operatorname{tr}(I_{tt}^{-1})$. The file's own cost is
#
# $$\chi^2 = \sum_e r_t^\top I_{tt}\, r_t + 2\, r_t^\top I_{tr}\, s + 2 (1 - \cos\theta)\, a^\top I_{rr}\, a, \qquad
# r_t = R_{ij}^\top \bigl( R_i^\top (t_j - t_i) - t_{ij} \bigr),$$
#
# for a rotation error by the angle $\theta$ about the axis $a$, with $s = a \sin\theta$. `solve`
# minimises it unless it is asked for $F$.

# %%
isotropic = pgo.PGOProblem(seen, weighting=pgo.Weighting.ISOTROPIC)
whole = pgo.PGOProblem(seen)
by_F, by_chi2 = solvers.solve(isotropic), solvers.solve(whole)
errors_of_map = {}
for name, found in (("F", by_F), ("chi2", by_chi2)):
    errors_of_map[name] = pgo.absolute_trajectory_error(found.poses, town.truth)
    print(
        f"optimum of {name:4}: F {isotropic.objective(found.poses):7.2f}, "
        f"chi2 {whole.objective(found.poses):7.2f}, {errors_of_map[name]:.3f} m off, "
        f"{found.verdict.name}, gap {found.certificate.gap_text}"
    )
pgo.compare_poses(seen, [("optimum of F", by_F.poses), ("optimum of chi2", by_chi2.poses)])

# %% [markdown]
# Both are certified, each for its own cost. The optimum of $F$ does not know that the camera sees
# sideways ten times better than in depth, and its map is worse. By $\chi^2$, other poses are proven to
# cost up to that share less (on the command line `pgo certify FILE --estimate theirs.g2o`):

# %%
judged = solvers.certify(whole, by_F.poses)
print(f"optimum of F, by chi2: gap {judged.gap:.3f}, {judged.verdict.name}")

# %% [markdown]
# ## A quadratic function that touches from below
#
# The rotation term of $\chi^2$ is quadratic in the rotations already. Without a coupling block
# $I_{tr}$, as here, the rest is a convex function of $r_t$. (With one it is not convex, and a part of
# the rotation term is moved to it that [makes it so](site/proved.md).) So it lies above its tangent at
# any point, and this tangent is quadratic in the poses: it is a cost like $F$, with a certificate like
# that of $F$.
#
# To see this, leave the minimum of $\chi^2$ along a line on which every pose turns and moves by random
# amounts. The grey curve is $\chi^2$ on that line, the blue one the tangent. Move the slider, which
# moves the point where they touch.

# %%
turns = rng.normal(0.0, 1.0, (whole.num_poses, 1))
moves = rng.normal(0.0, 1.0, by_chi2.poses.t.shape)


def poses_at(step):
    """The poses on the line, so many metres and radians from the minimum."""
    R = by_chi2.poses.R @ pgo.exp_map(step * turns)
    return pgo.Poses(R, by_chi2.poses.t + step * moves)


line = np.linspace(-0.3, 0.3, 41)
cost = np.array([whole.objective(poses_at(step)) for step in line])
touching = np.linspace(-0.24, 0.24, 9)
tangents = {}
for step in touching:
    tangent = whole.tangent_at(poses_at(step))
    tangents[step] = np.array([tangent.objective(poses_at(other)) for other in line])
frames = [
    [
        {"x": line, "y": below, "mode": "lines", "name": "tangent", "line": {"color": "#0072B2"}},
        {
            "x": [step],
            "y": [whole.objective(poses_at(step))],
            "mode": "markers",
            "name": "where they touch",
            "marker": {"color": "#D55E00", "size": 11},
        },
    ]
    for step, below in tangents.items()
]
pgo.animate(
    frames,
    [f"tangent at {step:+.2f}" for step in touching],
    still=[
        {"x": line, "y": cost, "mode": "lines", "name": "chi2", "line": {"color": "#999999"}},
    ],
    layout={
        "height": 420,
        "xaxis": {"title": {"text": "metres and radians from the minimum"}},
        "yaxis": {"title": {"text": "cost"}, "range": [-0.1 * cost.max(), 1.1 * cost.max()]},
    },
    title="chi2 on a line through its minimum, and its tangent",
    description=(
        "The curve of chi2 on a line through its minimum. For nine points of the line, the curve of "
        "the tangent there: it touches chi2 at this point, and is below it elsewhere."
    ),
)

# %% [markdown]
# Wherever they touch, the tangent is nowhere above $\chi^2$. So a lower bound of a tangent is one of
# $\chi^2$, whichever point was chosen. The best choice is the minimum of $\chi^2$: the gradient of the
# tangent is zero there, too, and if the relaxation of the tangent is tight, both have the same minimum.
# This is the proof behind the verdict above:

# %%
tangent = whole.tangent_at(by_chi2.poses)
Lambda = pgo.multipliers(tangent, by_chi2.poses)
bound = pgo.prove_bound(tangent, Lambda, poses=by_chi2.poses)
print(f"chi2 of the poses        {by_chi2.objective:.9f}")
print(f"bound, of the tangent    {bound:.9f}")
print(f"the library's own bound  {by_chi2.lower_bound:.9f}")

# %% [markdown]
# ## What the matrices say of the map
#
# How uncertain are the poses? The inverse of half the Hessian of $\chi^2$ is their
# covariance to first order, if the errors of the measurements are Gaussian:

# %%
blocks = by_chi2.marginals()
widest = int(np.argmax(np.linalg.eigvalsh(blocks[:, :2, :2])[:, -1]))
print(
    f"beside pose 0, pose {widest} is known to {np.sqrt(np.linalg.eigvalsh(blocks[widest, :2, :2])[-1]):.3f} m"
)
pgo.plot_graph(seen, by_chi2.poses, covariances=blocks)

# %% [markdown]
# ## Where it fails: a tangent far from the minimum
#
# A tangent elsewhere gives a valid bound, but a poorer one. `certify_at` takes the tangent and the
# multipliers at the poses that it is given. Here are its bounds at the optimum of $F$, and on the line
# of the film:

# %%
elsewhere = {"optimum of F": by_F.poses}
elsewhere |= {f"{step:.2f} away": poses_at(step) for step in (0.0, 0.01, 0.03, 0.06)}
bounds = {}
for name, poses in elsewhere.items():
    bounds[name] = pgo.certify_at(whole, poses).lower_bound
    print(f"{name:12} chi2 {whole.objective(poses):9.3f}, bound {bounds[name]:8.3f}")

# %% [markdown]
# At the optimum of $F$ hardly anything is lost. On the line the bound falls fast, down to zero, which
# needs no proof. So `certify` of poses that came from elsewhere takes its tangent at the best poses
# that it finds, not at those that it judges.

# %% [markdown]
# ## Exercises
#
# **1.** Give the camera the same error in all directions. What happens to the two optima?
#
# <details><summary>Answer</summary>
#
# In the plane $F$ and $\chi^2$ are then the same function, but for the weight of a rotation: $F$ has
# $\kappa \lVert R_j - R_i R_{ij} \rVert_F^2 = 4 \kappa (1 - \cos\theta)$, twice the term of $\chi^2$.
#
# ```python
# round_std = np.where(is_closure[:, None], [0.3, 0.3, np.deg2rad(3.0)], stds)
# same = replace(
#     seen,
#     kappa=round_std[:, 2] ** -2.0 / 2,
#     tau=round_std[:, 0] ** -2.0,
#     information=np.array([np.diag(std**-2.0) for std in round_std]),
# )
# of_F = solvers.solve(pgo.PGOProblem(same, weighting=pgo.Weighting.ISOTROPIC))
# assert np.isclose(of_F.objective, solvers.solve(same).objective, rtol=1e-9)
# ```
#
# </details>
#
# **2.** Multiply all information matrices by 4. What happens to the poses, the covariances and the gap?
#
# <details><summary>Answer</summary>
#
# The poses and the gap do not change, and the covariances are a quarter.
#
# ```python
# surer = solvers.solve(replace(seen, information=4 * seen.information))
# assert np.allclose(surer.poses.t, by_chi2.poses.t, atol=1e-6)
# assert np.allclose(4 * surer.marginals()[widest], blocks[widest], rtol=1e-6)
# ```
#
# </details>
#
# **3.** Couple the depth of a closure with its turn. Is the tangent still below $\chi^2$?
#
# <details><summary>Answer</summary>
#
# Yes. The terms other than that of the rotation are not convex then, and a part of the rotation's
# makes them so.
#
# ```python
# coupled_blocks = seen.information.copy()
# coupling = 0.5 * np.sqrt(coupled_blocks[:, 0, 0] * coupled_blocks[:, 2, 2])
# coupled_blocks[:, 0, 2] = coupled_blocks[:, 2, 0] = coupling
# rest = coupled_blocks[0].copy()
# rest[2, 2] = 0.0
# assert np.linalg.eigvalsh(rest)[0] < 0.0 < np.linalg.eigvalsh(coupled_blocks[0])[0]
# coupled = pgo.PGOProblem(replace(seen, information=coupled_blocks))
# below_coupled = coupled.tangent_at(by_chi2.poses)
# for step in (-0.3, 1e-2, 0.3):
#     assert below_coupled.objective(poses_at(step)) < coupled.objective(poses_at(step))
# ```
#
# </details>

# %% [markdown]
# ## Checks of the numbers above
#
# They hold for the parameters as they stand. A reader who has changed some may skip this cell.

# %%
with NamedNumbers():
    assert by_F.is_certified
    assert by_chi2.is_certified
    assert errors_of_map["chi2"] < 0.7 * errors_of_map["F"]
    assert judged.gap > 0.1
    assert not judged.is_certified
    assert np.isclose(1 - by_chi2.objective / judged.objective, judged.gap, rtol=1e-6)
    for step, below in tangents.items():
        assert (below <= cost * (1 + 1e-9)).all()
        touched = whole.objective(poses_at(step))
        assert np.isclose(whole.tangent_at(poses_at(step)).objective(poses_at(step)), touched)
    assert bound <= by_chi2.objective * (1 + 1e-12)
    assert bound > by_chi2.objective * (1 - 1e-9)
    assert max(bounds.values()) <= by_chi2.objective
    assert bounds["optimum of F"] > 0.99 * by_chi2.objective
    assert bounds["0.03 away"] < 0.5 * by_chi2.objective
    assert bounds["0.06 away"] == 0.0
