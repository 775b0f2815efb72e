# %% [markdown]
# # 16. Can an answer be proven optimal where the relaxation is loose?
#
# Open with `jupyter lab notebooks/16_beyond_the_relaxation.ipynb`;
# `pip install -e '.[notebooks,fast]'` installs it.
#
# - **Prerequisites:** [notebook 5](05_sdp_and_certificates.ipynb): the relaxation, its dual, and
#   what rank and gap mean; unit quaternions.
# - **Time:** 35 minutes
# - **Next:** [notebook 17](17_a_mission.ipynb), what a team knows while its mission goes on
#
# [Notebook 5](05_sdp_and_certificates.ipynb) ends where the semidefinite relaxation is no longer
# tight: the noise is strong, the proven bound stays below the cost of the best poses that are known,
# and the verdict is `NOT_CERTIFIED`. This notebook goes on from there. A *shift* gives a bound that
# is valid all the same. A look at what the relaxation does not know, the difference between a
# rotation and a reflection, gives terms that close the gap on many such graphs, and a loop of
# fifteen lines finds them. In the plane the same question has another answer. The films are drawn by
# [`drawings/beyond_the_relaxation.py`](drawings/beyond_the_relaxation.py).

# %%
import cvxpy as cp
import matplotlib.pyplot as plt
import numpy as np
from drawings.beyond_the_relaxation import ascent_film, edge_film
from drawings.checks import NamedNumbers

import pgo_models as pgo
import solvers
from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.scenes import NoiseModel, observe
from pgo_models.plots.curves import plot_tightness
from pgo_models.plots.matrix_plots import plot_spectrum
from solvers.studies.tightness import SweptScene, noisy_scene

plt.rcParams["figure.dpi"] = 150

# %% [markdown]
# ## A graph on which the relaxation is loose
#
# With the best translations, the cost $F$ of the paper is a quadratic form
# $F(R) = \operatorname{tr}(Y^\top Q Y)$ in the rotations, where $Y$ has the matrices $R_i^\top$ one
# below the other. The relaxation minimises $\operatorname{tr}(Q Z)$ over all positive semidefinite $Z$
# with $Z_{ii} = I$; the rotations themselves give $Z = Y Y^\top$, of rank 3. Its dual has a symmetric
# multiplier $\Lambda_i$ for every pose. If
#
# $$S = Q - \operatorname{blockdiag}(\Lambda)$$
#
# is positive semidefinite, then $\sum_i \operatorname{tr} \Lambda_i$ is a lower bound on $F$. Here is
# the paper's grid with a rotation noise of 60 degrees, twice the paper's. The setting
# `handedness=None` keeps `solve` to what the relaxation can prove.

# %%
problem = pgo.PGOProblem(noisy_scene(SweptScene.GRID, np.deg2rad(60), np.random.default_rng(3)))
n, d = problem.num_poses, problem.d
loose = solvers.solve(problem, solvers.Pipeline(handedness=None))
relaxed = pgo.solve_relaxation(problem)
print(f"{loose.verdict.name}: {loose.lower_bound:.3f} <= optimum <= {loose.objective:.3f}")
print(f"rank of Z: {relaxed.rank.rank}; Z rounded to rotations costs {relaxed.objective:.3f}")

# %% [markdown]
# $Z$ has rank 4. No rotations have this Gram matrix, and rounding it to rotations increases the cost.
# Either there are better poses, or the bound is too low. `NOT_CERTIFIED` does not say which.
#
# ## A bound with a shift
#
# There are two sets of multipliers to choose from, and neither of them fits. Those that belong to the
# poses (notebook 1) have $\sum_i \operatorname{tr} \Lambda_i = F$, but their $S$ has a negative
# eigenvalue. Those of the relaxation make $S$ positive semidefinite, but only just: their $S$ has
# *four* zero eigenvalues, and grounding a pose removes only three, so that no factorisation in
# floating point succeeds. A shift mends both. If $S + \eta I$ is positive semidefinite, then
# $\operatorname{tr}(Y^\top S Y) \ge -\eta \operatorname{tr}(Y^\top Y) = -\eta\, n d$ for all rotations,
# because $R_i R_i^\top = I$, and therefore
#
# $$F \ge \sum_i \operatorname{tr} \Lambda_i - \eta\, n d.$$


# %%
def certificate_matrix(Q, Lambda):
    """S = Q - blockdiag(Lambda)."""
    S = np.array(Q)
    side = Lambda.shape[1]
    for i, block in enumerate(Lambda):
        S[side * i : side * i + side, side * i : side * i + side] -= block
    return S


of_poses = pgo.multipliers(problem, loose.poses)
by_hand = {}
for name, Lambda in (("poses", of_poses), ("relaxation", loose.certificate.Lambda)):
    shift = max(0.0, -np.linalg.eigvalsh(certificate_matrix(problem.Q, Lambda))[0])
    trace = np.trace(Lambda, axis1=1, axis2=2).sum()
    by_hand[name] = trace - shift * n * d
    print(
        f"multipliers of the {name:11} sum of traces {trace:.3f}, "
        f"eta {shift:.1e}, bound {by_hand[name]:.3f}"
    )
print(f"the library, with eta {loose.certificate.eta:.1e}: bound {loose.lower_bound:.3f}")

# %% [markdown]
# The library searches for a small $\eta$ with which the factorisation succeeds in spite of rounding.
# In the picture of the spectrum, the shaded band is $|\lambda| \le \eta$; all four zeros are in it.

# %%
plot_spectrum(problem, loose.certificate, count=10)

# %% [markdown]
# No poses are better than ours by more than 0.24 %: a bound remains useful when the relaxation is
# loose, where a yes-or-no answer would not. But no shift and no multipliers can raise the bound
# beyond the value of the relaxation. For that it has to learn something about rotations.
#
# ## Rotations, not reflections
#
# What does the relaxation not know? It has $R_i R_i^\top = I$, but no determinant, so that it also
# admits reflections. Let $(i, j)$ be a pair of poses with $T = R_i^\top R_j$ at the answer, and let
# $E = T^\top R_i^\top R_j$ for any other rotations, which is $I$ at the answer. As a rotation, $E$ has
# a unit quaternion $(w, v)$, and the formula of a rotation matrix gives
# $E + E^\top = 4 v v^\top + (2 - 4 |v|^2) I$. For a positive semidefinite $3 \times 3$ matrix $P$ let
#
# $$W = \tfrac14 \bigl(\tfrac12 \operatorname{tr}(P)\, I - P\bigr), \qquad \text{so that} \qquad
#   \operatorname{tr}\bigl(W (2 I - E - E^\top)\bigr) = v^\top P v \ge 0.$$
#
# The left side is linear in $E$, and therefore quadratic in $Y$: it is
# $\operatorname{tr}(Y^\top B^\top W B\, Y)$ with $B Y = R_j^\top - T^\top R_i^\top$. On rotations it is
# never negative, and at the answer it is zero. On reflections it can be negative.

# %%
rng = np.random.default_rng(0)
P = np.outer(*2 * [rng.standard_normal(3)])
W = (np.trace(P) / 2 * np.eye(3) - P) / 4
rotations = pgo.random_rotations(100_000, 3, rng)
mirrored = rotations * np.array([1.0, 1.0, -1.0])
least = {}
for name, E in (("rotations", rotations), ("reflections", mirrored)):
    term = np.einsum("ab,kab->k", W, 2 * np.eye(3) - E - np.swapaxes(E, 1, 2))
    least[name] = term.min()
    print(f"{name:12} the term is at least {least[name]:6.3f}")

# %% [markdown]
# So the term may be *taken off* the cost. What is left is nowhere above $F$ on rotations and equal to
# it at the answer, and $S$ becomes $S - \sum_e B_e^\top W_e B_e$. A lower bound on what is left is one on
# $F$. And where a reflection made $S$ indefinite, the difference need not be.
#
# ## One edge
#
# Where does that help? Take a single edge that knows the rotation about its first axis better than
# that about the other two, as an edge of a g2o file can: the information of its rotation is
# $\operatorname{diag}(10, 2, 2)$. Its cost is $\operatorname{tr}(W_e (2 I - E - E^\top))$ with
# $W_e = \operatorname{diag}(-3, 5, 5)$, half the trace of the information less the information. No
# *rotation* makes it less than zero. A mirror does: moving $E$ from $I$ to the mirror image
# $I - 2 u u^\top$ costs $4 u^\top W_e u$, which is negative along the first axis. The relaxation pays with
# such moves. Take off the term with $P = p\, u u^\top$ for this axis, and move the slider.

# %%
information = np.diag([10.0, 2.0, 2.0])
W_edge = np.trace(information) / 2 * np.eye(3) - information
angles, share = np.linspace(0, np.pi, 31), np.linspace(0, 1, 11)
turns = [pgo.exp_map(angles[:, None] * u) for u in np.eye(3)[:2]]
mirrors = [np.eye(3) - 2 * share[:, None, None] * np.outer(u, u) for u in np.eye(3)[:2]]


def cost(weights, E):
    return np.einsum("ab,kab->k", weights, 2 * np.eye(3) - E - np.swapaxes(E, 1, 2))


settings = []
for p in range(0, 53, 4):
    P = np.diag([p, 0.0, 0.0])
    W_less = W_edge - (np.trace(P) / 2 * np.eye(3) - P) / 4
    settings.append((p, [cost(W_less, E) for E in turns], [cost(W_less, E) for E in mirrors]))
edge_film(settings, angles, share)

# %% [markdown]
# At $p = 0$ the blue line below, towards the mirror image in the first axis, is negative. It rises
# with $p$, while the blue curve of rotations and the orange line of the other mirror image fall. From
# $p = 24$ to $p = 40$ nothing is below zero: what rotations lose is never more than they cost. Beyond
# it the price is too high. On such an edge $P$ has a closed form. The edges of our graph have the same weight for all axes, so that none of
# them favours a reflection by itself. But where edges contradict each other strongly, reflections can
# cost less than rotations, and $P$ has to be searched for.
#
# ## The loop by hand
#
# We need a $P_e \succeq 0$ for every edge that makes $S - \sum_e B_e^\top W_e B_e$ positive definite,
# with one pose grounded. The smallest eigenvalue of this matrix is a concave function of all $P_e$,
# so climbing leads to its maximum. If $z$ is its eigenvector and $D_e = B_e z$, its derivative for
# $P_e$ is $(D_e D_e^\top - \tfrac12 |D_e|^2 I) / 4$. A step goes as far as the eigenvalue would need to
# become positive if it were linear (Polyak), and back to $P_e \succeq 0$. Where several eigenvalues
# are close together their eigenvectors count together, with the weights of a soft minimum.

# %%
R, i, j = loose.poses.R, problem.graph.i, problem.graph.j
S = certificate_matrix(problem.Q, of_poses)
T = np.swapaxes(R[i], 1, 2) @ R[j]
B = np.zeros((len(i), 3, n, 3))
B[np.arange(len(i)), :, j] = np.eye(3)
B[np.arange(len(i)), :, i] = -np.swapaxes(T, 1, 2)
B = B.reshape(len(i), 3, 3 * n)


def taken_off(P):
    """S less the terms of all edges, without the rows of pose 0, which is grounded."""
    W = (np.trace(P, axis1=1, axis2=2)[:, None, None] / 2 * np.eye(3) - P) / 4
    return (S - np.einsum("eai,eab,ebj->ij", B, W, B, optimize=True))[3:, 3:]


P = np.zeros((len(i), 3, 3))
spectra = []
for _step in range(100):
    values, vectors = np.linalg.eigh(taken_off(P))
    spectra.append(values)
    if values[0] > 0:
        break
    weights = np.exp((values[0] - values[:8]) / (0.1 * abs(values[0])))
    D = B[:, :, 3:] @ vectors[:, :8] * np.sqrt(weights / weights.sum())
    outer = D @ np.swapaxes(D, 1, 2)
    slope = (outer - np.trace(outer, axis1=1, axis2=2)[:, None, None] / 2 * np.eye(3)) / 4
    aim = 0.02 * abs(spectra[0][0]) - values[0]
    sizes, axes = np.linalg.eigh(P + 0.5 * aim / np.sum(slope**2) * slope)
    P = (axes * np.maximum(sizes, 0)[:, None, :]) @ np.swapaxes(axes, 1, 2)
print(f"{len(spectra) - 1} steps; smallest eigenvalues", *(f"{x:.2g}" for x in spectra[-1][:4]))

# %%
ascent_film(spectra)

# %% [markdown]
# The matrix is positive definite, and the gap is closed: no rotations, and no translations, have a
# smaller $F$ than ours. `HandednessTerms` holds the terms, `prove_bound` proves the bound of what they
# leave in exact arithmetic, and `loss` bounds what rounding can make of the terms themselves.

# %%
terms = HandednessTerms.at(loose.poses, i, j, P)
bound_of_rest = pgo.prove_bound(terms.taken_off(problem), of_poses, poses=loose.poses)
print(f"F of the poses {loose.objective:.9f}")
if bound_of_rest is None:  # on another graph
    print("no bound: the smallest eigenvalue is still negative")
else:
    print(f"proven bound   {bound_of_rest - terms.loss():.9f}")

# %% [markdown]
# ## The library agrees
#
# `solve` does this by default wherever the relaxation does not suffice. Its last stage is the ascent.

# %%
closed = solvers.solve(problem)
closed

# %%
starts = [pgo.random_rotations(n, d, np.random.default_rng(k)) for k in range(40)]
descents = [solvers.polish(problem, problem.with_best_translations(start)) for start in starts]
best_descent = min(problem.objective(poses) for poses in descents)
print(f"gap without terms {loose.gap:.2g}, with terms {closed.gap:.2g}")
print(f"best of 40 descents {best_descent:.6f}, proven minimum {closed.lower_bound:.6f}")

# %% [markdown]
# The poses were optimal all along, and the relaxation was to blame.
#
# ## The same as a tighter relaxation
#
# The constraint behind the terms can be given to the relaxation itself. For a rotation $E$ with the
# unit quaternion $q$ the $4 \times 4$ matrix $4 q q^\top$ is linear in $E$, and $Z_{ij}$ is a mixture of
# rotations, in the convex hull of $\mathrm{SO}(3)$, if and only if this matrix of $Z_{ij}$ is positive
# semidefinite (Saunderson, Parrilo and Willsky 2015). The terms are the multipliers of that
# constraint. Olsson, Lochman, Malmport and Zach (2025) add the hull to the semidefinite program of
# rotation averaging.

# %%
with_hulls = pgo.solve_relaxation(problem, pgo.RelaxationForm.HULL_DUAL)
for name, relaxation in (("without hulls", relaxed), ("with hulls", with_hulls)):
    print(
        f"{name:13} value {relaxation.value:.4f}, rank of Z {relaxation.rank.rank}, "
        f"Z rounded {relaxation.objective:.4f}, {relaxation.verdict.name}"
    )

# %% [markdown]
# With hulls the relaxation is tight. `solve` needs no model of cvxpy for it: where the ascent finds
# no suitable $P_e$, an augmented Lagrangian on a low-rank factor of $Z$ (`HullLagrangian`), which takes
# graphs of a thousand poses, solves this relaxation.
#
# ## In the plane
#
# Is the same to be had in the plane? The answer has two parts. The $2 \times 2$ matrices are the sum
# of two planes at right angles, with $\operatorname{tr}(A^\top C) = 0$ for $A$ in the one and $C$ in the
# other. The first holds the rotations, the second the reflections:
#
# $$\begin{pmatrix} a & -b \\ b & a \end{pmatrix} \qquad \text{and} \qquad
#   \begin{pmatrix} a & b \\ b & -a \end{pmatrix}.$$
#
# **For rotations alone nothing is gained.** What an edge contributes to the cost is
# $-2 \kappa \operatorname{tr}(R_{ij}^\top Z_{ij})$ and a constant. The measured $R_{ij}$ is a rotation, so the
# cost does not see the part of $Z_{ij}$ in the second plane. Let $J$ turn every pose by 90 degrees.
# Then $J^\top Z J$ has the same first parts as $Z$, and second parts of the opposite sign. It is
# feasible and costs the same, and so does the mean of the two, which has no second parts. Hence
# the relaxation never pays with reflections. Moreover, a block
# $\begin{pmatrix} a & -b \\ b & a \end{pmatrix}$ of a positive semidefinite $Z$ with $Z_{ii} = I$ has
# $a^2 + b^2 \le 1$, so it is in the convex hull of $\mathrm{SO}(2)$ already.
#
# **With translations it is different.** When they are eliminated, $Q$ also has products such as
# $t_{ij}^\top Z_{ik}\, t_{kl}$, and the matrix $t_{ij} t_{kl}^\top$ has a part in both planes. So the
# relaxation can save something by reflections. But on rotations the second part of $Z_{ik}$ is zero,
# and what $Q$ says of it may be deleted without changing the cost of any rotations:
#
# $$Q_c = \tfrac12 (Q + J^\top Q J).$$
#
# The relaxation of $Q_c$ is that of $Q$ over the $Z$ without second parts, so its value cannot be
# lower. Its blocks are complex numbers $a + b \mathrm i$: this is the relaxation in the complex domain
# (Calafiore, Carlone and Dellaert 2016). Here it is on a grid of 16 poses in the plane, at the paper's
# 30 degrees and with translations that are measured precisely.

# %%
side = 4
index = np.arange(side**2).reshape(side, side)
places = np.stack(np.unravel_index(index.ravel(), index.shape), axis=1).astype(float)
rng = np.random.default_rng(2)
truth = Poses(pgo.random_rotations(side**2, 2, rng), places)
first = np.concatenate([index[:-1].ravel(), index[:, :-1].ravel()])
second = np.concatenate([index[1:].ravel(), index[:, 1:].ravel()])
noise = NoiseModel(translation_std=0.1, rotation_std=np.deg2rad(30))
flat = pgo.PGOProblem(observe("flat grid", truth, first, second, noise, 1.0, 100.0, rng))
planar = solvers.solve(flat)
print(f"F {planar.objective:.5f}")


# %%
def value_of_relaxation(Q):
    """Least tr(Q Z) over positive semidefinite Z with Z_ii = I, in the plane."""
    Z = cp.Variable(Q.shape, PSD=True)
    blocks = [slice(k, k + 2) for k in range(0, len(Q), 2)]
    model = cp.Problem(cp.Minimize(cp.trace(Q @ Z)), [Z[b, b] == np.eye(2) for b in blocks])
    model.solve(solver=cp.CLARABEL)
    return model.value


J = np.kron(np.eye(side**2), np.array([[0.0, -1.0], [1.0, 0.0]]))
Q_real = np.array(flat.Q)
Q_complex = (Q_real + J.T @ Q_real @ J) / 2
Y = np.swapaxes(planar.poses.R, 1, 2).reshape(-1, 2)
in_the_plane = {}
for name, Q in (("Q", Q_real), ("Q_c", Q_complex)):
    products = (Q @ Y).reshape(-1, 2, 2) @ planar.poses.R
    Lambda = (products + np.swapaxes(products, 1, 2)) / 2
    S_flat = certificate_matrix(Q, Lambda)[2:, 2:]
    in_the_plane[name] = (
        np.sum(Y * (Q @ Y)),
        value_of_relaxation(Q),
        np.linalg.eigvalsh(S_flat)[0],
    )
    print(
        "{:4} cost of the poses {:.5f}, relaxation {:.5f}, smallest eigenvalue {:8.2g}".format(
            name, *in_the_plane[name]
        )
    )

# %% [markdown]
# Both matrices give the poses the same cost. With $Q$ the value of the relaxation is far below it, and
# $S$ without one pose has a negative eigenvalue. With $Q_c$ the relaxation is tight and $S$ is positive
# definite: these poses are optimal.
#
# *The library agrees.* Where a certificate by $Q$ stays open in the plane, `solve`, `certify` and
# `pgo verify` take rotations as complex numbers. They keep the translations, so that the matrix stays
# sparse, and one real multiplier for every pose is enough.

# %%
print(f"lower bound {planar.lower_bound:.5f}")
print(planar.certificate.proof)

# %% [markdown]
# ## Where it fails
#
# `noise_sweep` solves and certifies graphs with the geometry of the paper's circle and grid and
# increasing rotation noise, with and without handedness terms.

# %%
degrees = np.array([30.0, 45.0, 60.0, 75.0])
sweeps = {
    scene.value: solvers.noise_sweep(scene, np.deg2rad(degrees), 3, np.random.default_rng(0))
    for scene in SweptScene
}
curves = [(name, sweep.rotation_std, sweep.fraction) for name, sweep in sweeps.items()]
curves += [
    (f"{name}, handedness terms", sweep.rotation_std, sweep.fraction_with_terms)
    for name, sweep in sweeps.items()
]
plot_tightness(curves)

# %% [markdown]
# There are three graphs at every level, so one graph is a third. On the circle the terms close every gap.
# On the grid they reach further than the relaxation, but not to 75 degrees. Where no $P_e$ on the edges
# suffices, the bound is that of the relaxation with hulls, and the gap stays open: the hull of each
# $Z_{ij}$ is known, but not how the blocks around a cycle fit together.

# %% [markdown]
# ## Exercises
#
# **1.** Take $P_e = 10\, I$ for every edge. What is $v^\top P_e v$ for a rotation by an angle $\theta$?
# Why do such terms never help?
#
# <details><summary>Answer</summary>
#
# $|v| = \sin(\theta / 2)$, so the term is $10 \sin^2(\theta / 2)$. It is also positive on reflections:
# $W$ is a multiple of $I$, the term is a sum of squares for any $Y$, and what is taken off $S$ is
# positive semidefinite. Every eigenvalue falls.
#
# ```python
# alike = np.broadcast_to(10 * np.eye(3), (len(i), 3, 3))
# assert (np.linalg.eigvalsh(taken_off(alike)) <= spectra[0] + 1e-9).all()
# ```
#
# </details>
#
# **2.** Take off twice the terms that the loop has found. Is a bound from them still valid? Is the
# matrix still positive definite? And for the half of the terms?
#
# <details><summary>Answer</summary>
#
# Every $P_e \succeq 0$ gives a valid bound, but a bound equal to $F$ only if the matrix is positive
# definite. Twice or half the terms are too much or too little.
#
# ```python
# lowest = [np.linalg.eigvalsh(taken_off(factor * P))[0] for factor in (0.0, 0.5, 1.0, 2.0)]
# assert lowest[2] > 0 > max(lowest[0], lowest[1], lowest[3])
# assert lowest[1] >= (lowest[0] + lowest[2]) / 2  # the smallest eigenvalue is concave
# ```
#
# </details>
#
# **3.** `flat.L` is what the rotations of the edges contribute to $Q$. Compare $J^\top L J$ with $L$, and
# $J^\top Q J$ with $Q$. What follows for a graph of rotations without translations?
#
# <details><summary>Answer</summary>
#
# $J^\top L J = L$, so that $Q_c = Q$ if there are no translations, and nothing is gained. The
# translations make the difference.
#
# ```python
# L = flat.L.toarray()
# assert np.allclose(J.T @ L @ J, L)
# assert np.abs(J.T @ Q_real @ J - Q_real).max() > 1.0
# ```
#
# </details>

# %% [markdown]
# ## Checks of the numbers above
#
# This cell holds what the text says of the numbers above. If you have changed a parameter, skip it.

# %%
with NamedNumbers():
    assert not loose.is_certified
    assert relaxed.rank.rank == 4
    assert loose.certificate.eta > 0
    assert relaxed.lower_bound <= loose.objective < relaxed.objective
    assert 1e-4 < loose.gap < 0.01
    assert by_hand["poses"] < by_hand["relaxation"] < loose.objective
    assert abs(by_hand["relaxation"] - loose.lower_bound) < 0.01
    assert least["rotations"] > -1e-9
    assert least["reflections"] < -0.1
    for p, of_rotations, of_mirrors in settings:
        none_below = min(costs.min() for costs in of_rotations + of_mirrors) > -1e-9
        assert none_below == (24 <= p <= 40)
    assert spectra[0][0] < 0 < spectra[-1][0]
    assert len(spectra) < 50
    assert terms.num_pairs > 0
    assert bound_of_rest is not None
    proven = bound_of_rest - terms.loss()
    assert loose.objective * (1 - 1e-9) < proven <= loose.objective
    assert closed.is_certified
    assert closed.stages[-1].name == "HandednessAscent"
    assert closed.lower_bound <= best_descent * (1 + 1e-12)
    assert loose.lower_bound < closed.lower_bound
    assert with_hulls.verdict is pgo.Verdict.CERTIFIED
    assert with_hulls.rank.rank == 3
    assert np.isclose(in_the_plane["Q"][0], in_the_plane["Q_c"][0])
    assert planar.is_certified
    assert planar.certificate.bound.is_complex
    assert in_the_plane["Q"][1] < 0.9 * planar.objective
    assert np.isclose(in_the_plane["Q_c"][1], planar.objective, rtol=1e-4)
    assert in_the_plane["Q"][2] < 0 < in_the_plane["Q_c"][2]
    assert sweeps["circle"].fraction[0] == sweeps["grid"].fraction[0] == 1.0
    assert sweeps["circle"].fraction[-1] < 0.5
    assert sweeps["circle"].fraction_with_terms[-1] == 1.0
    assert sweeps["grid"].fraction[-1] == sweeps["grid"].fraction_with_terms[-1] == 0.0
    assert sweeps["circle"].last_tight > sweeps["grid"].last_tight
    assert (sweeps["grid"].fraction_with_terms >= sweeps["grid"].fraction).all()
