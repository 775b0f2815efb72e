# %% [markdown]
# # 10. What else can be proven?
#
# Open with `jupyter lab notebooks/10_what_else_can_be_proven.ipynb`;
# `pip install -e '.[notebooks,fast]'` installs it.
#
# - **Prerequisites:** [notebook 5](05_sdp_and_certificates.ipynb), which proves pose graphs; some
#   cvxpy
# - **Time:** 30 minutes
# - **Next:** [notebook 11](11_admm_across_machines.ipynb), one problem that is solved across machines
#
# Pose graphs come with a proof that no other poses cost less. Nothing in that proof needs a pose
# graph: it needs a sum of squares, and rotations. This notebook takes models of one's own, written
# in cvxpy, and asks of each how much can be proven. It builds the bound by hand, shows which
# equations close it, and ends where nothing closes. What only draws is in
# [`drawings/what_else_can_be_proven.py`](drawings/what_else_can_be_proven.py).

# %%
import itertools

import cvxpy as cp
import numpy as np
from drawings.checks import NamedNumbers
from drawings.what_else_can_be_proven import draw_bounds, film_of_constraints, slider_of_noise

import pgo_models as pgo
import solvers
from pgo_models.convex.orthogonality_examples import procrustes

# %% [markdown]
# ## Seven points and seven planes
#
# A scanner has seen points $p_i$, which lie on planes of a known model with normals $n_i$ through
# the points $q_i$. Which rotation $R$ and translation $t$ bring the points onto their planes?
#
# $$\min_{R \in SO(3),\, t} \; \sum_i \bigl(n_i^\top (R p_i + t - q_i)\bigr)^2$$
#
# Every step of ICP with planes is this problem. It has no closed form, and with few points and much
# noise it has several local minima. The model is five lines of cvxpy; `OrthogonalProblem` adds what
# cvxpy cannot say.


# %%
def registration(noise, seed, count=7):
    rng = np.random.default_rng(seed)
    points, normals = rng.standard_normal((2, count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    truth = pgo.random_rotations(1, 3, rng)[0]
    seen = points @ truth.T + noise * rng.standard_normal((count, 3))
    R, t = cp.Variable((3, 3), name="R"), cp.Variable(3, name="t")
    moved = points @ R.T + np.ones((count, 1)) @ cp.reshape(t, (1, 3), order="C")
    distances = cp.sum(cp.multiply(normals, moved - seen), axis=1)
    fit = cp.Problem(cp.Minimize(cp.sum_squares(distances)))
    return pgo.OrthogonalProblem(fit, rotations=[R])


model = registration(noise=0.5, seed=7)
runs = [solvers.solve_orthogonal(model, seed, starts=1).outcome for seed in range(8)]
single = [run.objective for run in runs]
print("runs of one start end at", np.round(sorted(single), 3))

# %% [markdown]
# Runs from different starts end at different costs, and all of them have converged. Is the least of
# them the least of all?
#
# ## A bound by hand
#
# The cost is quadratic in the entries of $R$ and $t$. With the best $t$ put in it is $u^\top Q u$
# with ten numbers, $u = (\operatorname{vec} R, 1)$. `quadratic_form` reads $Q$ from cvxpy.
#
# What makes $R$ a rotation is quadratic, too: equations $u^\top A_k u = 0$ with symmetric $A_k$.
# Now replace $u u^\top$ by *any* positive semidefinite $Z$ that satisfies them:
#
# $$\min_{Z \succeq 0} \; \operatorname{tr}(Q Z) \quad \text{subject to} \quad
# \operatorname{tr}(A_k Z) = 0, \quad Z_{10,10} = 1.$$
#
# This is a convex problem, and since $u u^\top$ is one of the $Z$ its least cost is a *lower bound*
# for all rotations. The more equations, the fewer $Z$, and the higher the bound.

# %%
form = pgo.quadratic_form(model)
Q = form.reduction.T @ form.Q.toarray() @ form.reduction  # with the best t
Z = cp.Variable((10, 10), PSD=True)


def relaxation(Q, equations):
    constraints = [Z[9, 9] == 1.0] + [cp.trace(A @ Z) == 0.0 for A in equations]
    relaxed = cp.Problem(cp.Minimize(cp.trace(Q @ Z)), constraints)
    relaxed.solve(solver=cp.CLARABEL)
    return relaxed.value, np.linalg.eigvalsh(Z.value)[::-1]


def equation(*terms):
    A = np.zeros((10, 10))
    for i, j, factor in terms:
        A[i, j] += factor / 2.0
        A[j, i] += factor / 2.0
    return A


# %% [markdown]
# There are three families. Columns are orthonormal, $R^\top R = I$: six equations. Rows are, too,
# $R R^\top = I$: six more. For a *matrix* the first six imply the other six; for $Z$ they do not.
# Neither family sees the difference between a rotation and a mirror. That is what the cross products
# say: $c_1 \times c_2 = c_3$, and so on around, nine equations of *handedness*.


# %%
def at(row, column):
    return 3 * column + row % 3


pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
columns = []
rows = []
for j, k in pairs:
    is_norm = -float(j == k)
    columns.append(equation(*((at(i, j), at(i, k), 1.0) for i in range(3)), (9, 9, is_norm)))
    rows.append(equation(*((at(j, i), at(k, i), 1.0) for i in range(3)), (9, 9, is_norm)))
handedness = []
for j in range(3):
    k, last = (j + 1) % 3, (j + 2) % 3
    for i in range(3):
        product = (at(i + 1, j), at(i + 2, k), 1.0), (at(i + 2, j), at(i + 1, k), -1.0)
        handedness.append(equation(*product, (at(i, last), 9, -1.0)))

families = {"columns": columns, "columns and rows": columns + rows}
families["with handedness"] = columns + rows + handedness
least = min(single)
gaps = {}
bounds = {}
for name, equations in families.items():
    bounds[name], _ = relaxation(Q, equations)
    gaps[name] = 1.0 - bounds[name] / least
    print(f"{name:17} bound {bounds[name]:.4f}, gap {abs(gaps[name]):.1%}")
draw_bounds(bounds, single)

# %% [markdown]
# With orthonormality alone nearly half of the cost remains in doubt. With handedness nothing
# does: the least of the runs is the least of all. The film adds one equation after the other. Below
# are the eigenvalues of $Z$. A single one that is not zero means $Z = u u^\top$, so that the
# relaxation has found the rotation itself.

# %%
every = families["with handedness"]
steps = [relaxation(Q, every[:count]) for count in range(len(every) + 1)]
film_of_constraints(
    [("columns", 6), ("rows", 6), ("handedness", 9)],
    np.array([bound for bound, _ in steps]),
    np.array([spectrum for _, spectrum in steps]),
    least,
)

# %% [markdown]
# ## The library agrees
#
# `solve_orthogonal` does the same, and one thing more. The value of a solver has seven digits, so
# that it may lie *above* the least cost, and is no bound. The library takes the multipliers of the
# equations, moves them until they fit the rotation that it has found, and proves with rounding
# counted that $Q - \sum_k \lambda_k A_k - g e e^\top$ is positive semidefinite. Then
# $J \ge g$ for every rotation.

# %%
solution = solvers.solve_orthogonal(model)
print(solution)

# %% [markdown]
# Values of somebody else are judged as well, here those of the worst of the runs above:

# %%
worst = max(runs, key=lambda run: run.objective)
judged = solvers.certify(model, worst.state.copies)
print(judged)

# %% [markdown]
# ## How much noise may there be?
#
# Move the slider from noise of 1 % of the scene's size to 100 %, twelve draws at each. With
# orthonormality alone the bound is mostly zero at 1 %, since something between a rotation and a
# mirror fits seven planes for nothing. With handedness every draw closes.

# %%
orthonormality, handed = families["columns and rows"], families["with handedness"]
by_noise = {}
for noise in (0.01, 0.1, 0.3, 0.5, 1.0):
    draws = {"orthonormality": [], "handedness": []}
    for seed in range(12):
        drawn = registration(noise, seed)
        best = solvers.solve_orthogonal(drawn)
        drawn_form = pgo.quadratic_form(drawn)
        drawn_Q = drawn_form.reduction.T @ drawn_form.Q.toarray() @ drawn_form.reduction
        draws["orthonormality"].append(
            1.0 - relaxation(drawn_Q, orthonormality)[0] / best.objective
        )
        draws["handedness"].append(best.gap)
    by_noise[noise] = {name: np.array(values) for name, values in draws.items()}
slider_of_noise(by_noise)

# %% [markdown]
# ## Hand and eye
#
# A camera sits on the hand of a robot. The hand moves by $A_k$, the camera sees that it has moved by
# $B_k$, and $X$ is where the camera sits: $A_k X = X B_k$. Nothing has to be derived; the residuals
# are written down.


# %%
def hand_eye(motions, noise, seed):
    rng = np.random.default_rng(seed)
    X, *R_B = pgo.random_rotations(motions + 1, 3, rng)
    t_X, *t_B = rng.standard_normal((motions + 1, 3))
    R, t = cp.Variable((3, 3), name="R"), cp.Variable(3, name="t")
    residuals = []
    for R_Bk, t_Bk in zip(R_B, t_B, strict=True):
        R_A = pgo.project_to_rotations(X @ R_Bk @ X.T + noise * rng.standard_normal((3, 3)))
        t_A = X @ t_Bk + t_X - R_A @ t_X + noise * rng.standard_normal(3)
        residuals += [cp.vec(R_A @ R - R @ R_Bk, order="F"), R_A @ t + t_A - R @ t_Bk - t]
    fit = cp.Problem(cp.Minimize(cp.sum_squares(cp.hstack(residuals))))
    return pgo.OrthogonalProblem(fit, rotations=[R]), X


calibration, X = hand_eye(motions=5, noise=0.1, seed=0)
found = solvers.solve_orthogonal(calibration)
print(found.verdict.name, f"gap {found.gap:.0e}")
print("largest error of an entry of R:", np.abs(found.values[0] - X).max().round(3))

# %% [markdown]
# ## Mirrors welcome
#
# $\min \lVert A X - B \rVert$ over $O(4)$ has a closed form, $U V^\top$ of the singular value
# decomposition of $A^\top B$, and so shows whether the certificate tells the truth. A run cannot leave the
# half of $O(4)$ in which it starts, rotations or mirrors; the starts take both.

# %%
rng = np.random.default_rng(0)
A, B = rng.standard_normal((2, 6, 4))
U, _, Vt = np.linalg.svd(A.T @ B)
nearest = solvers.solve_orthogonal(procrustes(A, B))
error = np.abs(nearest.values[0] - U @ Vt).max()
print(nearest.verdict.name, f"gap {nearest.gap:.0e}; differs from U V^T by {error:.0e}")

# %% [markdown]
# ## Where it fails
#
# 1. **Costs that are not quadratic.** A sum of *distances* resists wrong points better than a sum of
#    squares, and is convex, but no quadratic form. What is proven of it is the least cost over the
#    *convex hull* of the rotations, which leaves a gap; the library says how wide.
# 2. **Equations that say too little.** The two columns $X$ with the least
#    $\operatorname{tr}(X^\top C X N)$, $N = \operatorname{diag}(1, 2)$, are eigenvectors of $C$ (Brockett), and the
#    runs find them. But the equations of $X^\top X = I$ in six dimensions do not say
#    $X X^\top \preceq I$, and without it nothing better than $J \ge 0$ follows. The multiplier
#    of this inequality, a positive semidefinite matrix, is that of sorting the eigenvalues: the
#    library knows it in closed form, and has the proof.

# %%
points = rng.standard_normal((40, 3))
truth = pgo.random_rotations(1, 3, rng)[0]
seen = points @ truth.T + 0.02 * rng.standard_normal(points.shape)
seen[:12] = rng.standard_normal((12, 3))
R = cp.Variable((3, 3), name="R")
distances = cp.Problem(cp.Minimize(cp.sum(cp.norm(points @ R.T - seen, axis=1))))
robust = solvers.solve_orthogonal(pgo.OrthogonalProblem(distances, rotations=[R]), starts=2)
least_squares = pgo.project_to_rotations(seen.T @ points)


def degrees(R):
    return np.degrees(np.arccos(np.clip((np.trace(R.T @ truth) - 1.0) / 2.0, -1.0, 1.0)))


errors = degrees(least_squares), degrees(robust.values[0])
print("off by {:.2f} degrees by squares, {:.2f} by distances".format(*errors))
print(f"distances: {robust.verdict.name}, gap {robust.gap:.1%}")


# %%
half = np.random.default_rng(0).standard_normal((6, 6))
X = cp.Variable((6, 2), name="X")
trace = cp.sum_squares(half @ X @ np.diag([1.0, 2.0**0.5]))
brockett = solvers.solve_orthogonal(
    pgo.OrthogonalProblem(cp.Problem(cp.Minimize(trace)), orthogonal=[X])
)
eigenvalues = np.linalg.eigvalsh(half.T @ half)
known = 2.0 * eigenvalues[0] + eigenvalues[1]
print(
    f"J = {brockett.objective:.6f}, by eigenvalues {known:.6f}; lower bound {brockett.lower_bound}"
)

# %% [markdown]
# ## Exercises
#
# **1.** The nine equations of handedness alone, without orthonormality: what do they prove?
#
# <details><summary>Answer</summary>
#
# Three columns each of which is the cross product of the others are a rotation, or zero. Zero is
# what the relaxation may mix in, so that the bound is worse.
#
# ```python
# alone, _ = relaxation(Q, handedness)
# assert alone < 0.9 * least
# ```
#
# </details>
#
# **2.** Maximise $\operatorname{tr}(X^\top C X)$ over two orthonormal columns, for a symmetric $C$.
# cvxpy refuses to maximise a convex function. What does `OrthogonalProblem` suggest?
#
# <details><summary>Answer</summary>
#
# It gives the $c$ of $c \lVert X \rVert^2$, which is constant on $X^\top X = I$. With it the cost is
# a sum of squares, and the answer is the sum of the two largest eigenvalues.
#
# ```python
# C, X = np.diag([4.0, 3.0, 1.0]), cp.Variable((3, 2), name="X")
# try:
#     pgo.OrthogonalProblem(cp.Problem(cp.Maximize(cp.sum_squares(C**0.5 @ X))), orthogonal=[X])
# except pgo.PGOError as refused:
#     print(refused)
# L = np.sqrt(4.04 * np.eye(3) - C)
# convex = cp.Problem(cp.Minimize(cp.sum_squares(L @ X)))
# largest = solvers.solve_orthogonal(pgo.OrthogonalProblem(convex, orthogonal=[X]))
# assert np.isclose(2 * 4.04 - largest.objective, 4.0 + 3.0)
# ```
#
# </details>

# %% [markdown]
# ## Checks of the numbers above
#
# Readers who have changed parameters may skip this cell, which holds for those given.

# %%
with NamedNumbers():
    assert max(single) > 1.1 * min(single)
    assert gaps["columns"] > gaps["columns and rows"]
    assert 0.4 < gaps["columns and rows"] < 0.46
    assert abs(gaps["with handedness"]) < 1e-5
    assert all(after > before - 1e-5 for (before, _), (after, _) in itertools.pairwise(steps))
    assert solution.is_certified
    assert np.isclose(solution.objective, least)
    assert not judged.is_certified
    assert judged.gap > 0.4
    assert by_noise[0.3]["orthonormality"].mean() > 0.2
    assert all((values["handedness"] <= 1e-6).all() for values in by_noise.values())
    assert found.is_certified
    assert nearest.is_certified
    assert error < 1e-9
    assert errors[1] < 1.0 < errors[0]
    assert 0.0 < robust.gap < 1.0
    assert np.isclose(brockett.objective, known)
    assert brockett.is_certified
