# %% [markdown]
# # 10. What else does splitting solve, where orthogonality is the only difficulty?
#
# Open with `jupyter lab notebooks/10_soc_beyond_robots.ipynb`; `pip install -e '.[notebooks,fast]'`
# installs it.
#
# The three steps of the paper's equation (19) do not depend on robots: (a) is any convex problem,
# (b) a projection, (c) a sum. This notebook solves four problems from other fields, each beside the
# usual method: localised modes of a vibrating plate, a rotation fitted to points of which some are
# wrong, interpretable principal components, and the sparse low-rank approximation that the paper's
# second remark names for compressing what robots send.

# %%
import itertools

import cvxpy as cp
import matplotlib.pyplot as plt
import numpy as np
from scipy.fft import dct, idct

import pgo_models as pgo
import solvers
from pgo_models.convex.orthogonality_examples import procrustes, sparse_components, sparse_low_rank
from pgo_models.convex.prox import project_sparse, project_stiefel, soft_threshold

plt.rcParams["figure.dpi"] = 110


# %% [markdown]
# ## Compressed modes
#
# The eigenvectors of a Laplacian are waves that extend over the whole plate. Ozolins, Lai, Caflisch
# and Osher (2013) compute orthonormal columns that are local instead, by a penalty on the 1-norm:
#
# $$\min_X \; \operatorname{tr}(X^\top A X) + w \sum |X_{ij}| \quad \text{subject to} \quad X^\top X = I.$$
#
# The problem is convex except for the constraint. Split it twice: a copy $P$ carries the
# constraint, and a copy $Q$ the 1-norm. Then (a) is a linear system with one matrix for all
# iterations, (b) two proximal operators in closed form, an SVD and a soft threshold
# ($\operatorname{sign}(v) \max(|v| - s, 0)$, in `pgo_models.convex.prox`), (c) two sums.


# %%
def compressed_modes(A, count, weight, rho, iterations, rng):
    P = Q = project_stiefel(rng.standard_normal((len(A), count)))
    B, C = np.zeros_like(P), np.zeros_like(Q)
    solve = np.linalg.inv(2 * A + 2 * rho * np.eye(len(A)))
    for _ in range(iterations):
        X = solve @ (rho * (P - B) + rho * (Q - C))  # (a)
        P, Q = project_stiefel(X + B), soft_threshold(X + C, weight / rho)  # (b), one for each copy
        B, C = B + X - P, C + X - Q  # (c)
    return P, Q, np.linalg.norm(X - P) + np.linalg.norm(X - Q)


def price(A, weight, X):
    return np.sum(X * (A @ X)) + weight * np.abs(X).sum()


def path_laplacian(count):
    D = np.diff(np.eye(count), axis=0)
    return D.T @ D


side = 16
line = path_laplacian(side)
plate = np.kron(line, np.eye(side)) + np.kron(np.eye(side), line)
waves = np.linalg.eigh(plate)[1][:, :4]
modes, thresholded, residual = compressed_modes(plate, 4, 0.2, 8.0, 800, np.random.default_rng(0))
print(f"residual {residual:.0e}; nonzeros of {side**2}: {(np.abs(thresholded) > 1e-9).sum(axis=0)}")
print(
    f"objective: compressed {price(plate, 0.2, modes):.3f}, eigenvectors {price(plate, 0.2, waves):.3f}"
)

figure, panels = plt.subplots(2, 4, figsize=(7.0, 3.6), layout="constrained")
for row, (name, columns) in enumerate((("eigenvector", waves), ("compressed mode", modes))):
    for k in range(4):
        field = columns[:, k].reshape(side, side)
        panels[row, k].imshow(
            field, cmap="RdBu", vmin=-np.abs(field).max(), vmax=np.abs(field).max()
        )
        panels[row, k].set_title(f"{name} {k + 1}", fontsize=8)
        panels[row, k].axis("off")

# %% [markdown]
# The upper row shows the eigenvectors, the lower row the compressed modes. Each mode is local, and
# exactly zero elsewhere. The modes are not eigenvectors; as $w$ goes to zero they span the same
# space.
#
# ## The library agrees
#
# `sparse_components` is the same problem for `solve_orthogonal`, whose step (a) uses cvxpy and
# Clarabel and keeps the 1-norm. This is another splitting with the same stationary points. Started
# at our solution, it stays there.

# %%
string = path_laplacian(20)
by_hand, _, _ = compressed_modes(string, 2, 0.2, 8.0, 1500, np.random.default_rng(1))
small = sparse_components(string, 2, 0.2)
run = solvers.run(
    solvers.OrthogonalSOC(penalty=8.0, tolerance=1e-4, max_iterations=300),
    small,
    small.point([by_hand]),
)
print(
    f"objective by hand {price(string, 0.2, by_hand):.6f}, by the library {run.objective:.6f}, {run.status.name}"
)

# %% [markdown]
# ## A rotation, and points of which some are wrong
#
# Two scans of the same points are rotated relative to each other: this is Procrustes' problem. The
# sum of *squares* has the closed form of [notebook 4](04_splitting_orthogonality.ipynb), but one
# point that is matched to the wrong partner changes the rotation. The sum of *distances* has no
# closed form, and is also convex.

# %%
rng = np.random.default_rng(1)
truth = pgo.random_rotations(1, 3, rng)[0]
points = rng.standard_normal((40, 3))


def scan(share):
    seen = points @ truth + 0.02 * rng.standard_normal(points.shape)
    wrong = rng.permutation(len(points))[: round(share * len(points))]
    seen[wrong] = rng.standard_normal((len(wrong), 3))
    return seen


def degrees(X):
    return np.degrees(np.arccos(np.clip((np.trace(X.T @ truth) - 1) / 2, -1.0, 1.0)))


shares, errors = (0.0, 0.2, 0.4), {}
for share in shares:
    seen = scan(share)
    squares = pgo.project_to_rotations((points.T @ seen)[None])[0]
    X = cp.Variable((3, 3))
    distances = cp.Problem(cp.Minimize(cp.sum(cp.norm(points @ X - seen, axis=1))))
    fit = pgo.OrthogonalProblem(distances, rotations=[X])
    found = solvers.run(solvers.OrthogonalSOC(tolerance=1e-4), fit, fit.point([squares]))
    errors[share] = degrees(squares), degrees(found.state.copies[0])
    print(
        "{:.0%} wrong: off by {:5.2f} degrees by squares, {:.2f} by distances".format(
            share, *errors[share]
        )
    )
assert np.isclose(
    procrustes(points, seen, rotation=True).objective([squares]),
    np.sum((points @ squares - seen) ** 2),
)

# %% [markdown]
# ## Interpretable principal components
#
# There are thirty sensors and three hidden causes, each of which affects eight sensors. Principal
# components mix the causes, since every rotation of them explains the same variance. With a penalty
# on the 1-norm, mixing has a cost.

# %%
causes = np.zeros((30, 3))
for k in range(3):
    causes[10 * k : 10 * k + 8, k] = 8**-0.5
readings = rng.standard_normal((80, 3)) @ np.diag(
    [3.0, 2.8, 2.6]
) @ causes.T + 0.5 * rng.standard_normal((80, 30))
covariance = readings.T @ readings / 80
values, vectors = np.linalg.eigh(covariance)
principal = vectors[:, -3:]
sparse = sparse_components(
    values[-1] * np.eye(30) - covariance, 3, 0.6
)  # largest of C: smallest of c I - C
components = solvers.run(
    solvers.OrthogonalSOC(tolerance=1e-4), sparse, sparse.point([principal])
).state.X[0]


def likeness(X):
    return np.abs(X.T @ causes).max(axis=1)


explained = [
    np.trace(X.T @ covariance @ X) / values.sum() for X in (principal, project_stiefel(components))
]
print(
    "likeness to a cause: principal",
    likeness(principal).round(2),
    " sparse",
    likeness(components).round(2),
)
print("variance explained: principal {:.1%}, sparse {:.1%}".format(*explained))
figure, panels = plt.subplots(1, 2, figsize=(7.0, 1.8), layout="constrained", sharey=True)
for axes, title, X in zip(panels, ("principal", "sparse"), (principal, components), strict=True):
    axes.imshow(X.T, cmap="RdBu", vmin=-0.5, vmax=0.5, aspect="auto")
    axes.set(title=title, xlabel="sensor", yticks=range(3))

# %% [markdown]
# ## Sparse low-rank approximation
#
# The paper's remark: robots send samples that are similar to each other (*low rank*) and smooth in
# time (*sparse* in a cosine transform). SLRMA (Hou, Chau, Magnenat-Thalmann and He 2017) uses both
# properties:
#
# $$\min_{B, C} \lVert Y - B C \rVert_F^2 \quad \text{subject to} \quad B^\top B = I, \quad \lVert B \rVert_0 \le s.$$
#
# For a given $B$ the best $C$ is $B^\top Y$, and the remaining cost
# $\lVert Y \rVert^2 - \lVert B^\top Y \rVert^2$ is concave. On $B^\top B = I$ it is
# $\operatorname{tr}(B^\top (c I - Y Y^\top) B)$ plus a constant, convex for
# $c = \lVert Y \rVert_2^2$. Now $B$ must be in *two* sets, neither of which is convex, and it has a
# copy in each.

# %%
rng = np.random.default_rng(2)
time_steps, robots, rank, rho_share = 64, 24, 4, 3.0
paths = np.cumsum(np.cumsum(rng.standard_normal((time_steps, robots)), axis=0), axis=0)
paths = (paths - paths.mean(axis=0)) @ (
    0.3 * np.eye(robots) + rng.standard_normal((robots, robots)) / robots
)
paths /= np.linalg.norm(paths, 2)  # in units in which c = 1
Y = dct(paths, axis=0, norm="ortho")
U, spectrum, _ = np.linalg.svd(Y, full_matrices=False)
c = spectrum[0] ** 2


def slrma(nonzeros, iterations):
    rho = rho_share * c
    solve = np.linalg.inv(2 * (c * np.eye(time_steps) - Y @ Y.T) + 2 * rho * np.eye(time_steps))
    P, Q = U[:, :rank], project_sparse(U[:, :rank], nonzeros)
    B_P, B_Q = np.zeros_like(P), np.zeros_like(Q)
    for _ in range(iterations):
        X = solve @ (rho * (P - B_P) + rho * (Q - B_Q))
        P, Q = project_stiefel(X + B_P), project_sparse(X + B_Q, nonzeros)
        B_P, B_Q = B_P + X - P, B_Q + X - Q
    return P, Q


def relative_error(basis):
    return np.linalg.norm(Y - basis @ np.linalg.lstsq(basis, Y, rcond=None)[0]) / np.linalg.norm(Y)


kept = (12, 16, 24, 40, 64)
curves = {
    "SLRMA": [relative_error(slrma(s, 2000)[1]) for s in kept],
    "SVD, small entries cut": [relative_error(project_sparse(U[:, :rank], s)) for s in kept],
}
figure, axes = plt.subplots(figsize=(5.0, 2.8), layout="constrained")
for (name, curve), marker in zip(curves.items(), "os", strict=True):
    axes.plot(kept, curve, f"{marker}-", label=name)
axes.axhline(
    relative_error(U[:, :rank]),
    color="#999999",
    linestyle=":",
    label=f"SVD, all {rank * time_steps} entries",
)
axes.set(xlabel="nonzeros of B", ylabel="relative error")
_ = axes.legend(fontsize=8)

# %% [markdown]
# The library takes the same steps, with one copy for each set and the same penalty.

# %%
problem = sparse_low_rank(Y, rank, 24)
states = solvers.iterate(
    solvers.OrthogonalSOC(penalty=rho_share * c), problem, problem.point([U[:, :rank]])
)
library = next(itertools.islice(states, 20, None)).copies
difference = max(np.abs(a - b).max() for a, b in zip(library, slrma(24, 20), strict=True))
print(f"after 20 iterations the copies differ by {difference:.0e}")

# %%
restored = slrma(24, 2000)[1]
decoded = idct(restored @ np.linalg.lstsq(restored, Y, rcond=None)[0], axis=0, norm="ortho")
figure, axes = plt.subplots(figsize=(5.0, 2.4), layout="constrained")
axes.plot(paths[:, :4], color="#999999", linewidth=2.5)
axes.plot(decoded[:, :4], color="#0072B2", linewidth=1.0)
axes.set(
    xlabel="time", ylabel="position", title="four of the robots, and from 24 numbers and 4 a robot"
)
sent = np.count_nonzero(restored) + rank * robots
print(f"{sent} numbers in place of {Y.size}; error {relative_error(restored):.1%}")

# %% [markdown]
# ## Where it fails
#
# 1. As with robots, $\rho$ has a threshold, which the multipliers of the constraint determine.
#    Below it the modes do not converge.
# 2. The result is a *stationary point*. The compressed modes of another initial estimate are
#    elsewhere. With two sets that are not convex, as in SLRMA, a random initial estimate mostly
#    gives a worse result than that of the SVD.

# %%
never = compressed_modes(plate, 4, 0.2, 1.0, 800, np.random.default_rng(0))[2]
objectives = [
    price(plate, 0.2, compressed_modes(plate, 4, 0.2, 8.0, 800, np.random.default_rng(k))[0])
    for k in range(5)
]
print(f"rho = 1: residual {never:.1f} after 800 iterations")
print("rho = 8, other starts: objectives", np.round(sorted(objectives), 3))

# %% [markdown]
# ## Exercises
#
# **1.** Which $\rho$ does a larger $w$ need? Find by trial a value with which the modes converge at
# $w = 0.5$, where 8 is too small.
#
# <details><summary>Answer</summary>
#
# The subgradient of $w \sum |X|$ grows with $w$, and with it the multiplier of $X^\top X = I$ that
# has to balance it. The threshold of $\rho$ grows in proportion.
#
# ```python
# settled = {rho: compressed_modes(plate, 4, 0.5, rho, 800, np.random.default_rng(0))[2] for rho in (8.0, 20.0)}
# assert settled[8.0] > 0.1 > 100 * settled[20.0]
# ```
#
# </details>
#
# **2.** No answer of `sparse_components` is below the sum of the smallest eigenvalues plus $w$
# times the number of columns. Why?
#
# <details><summary>Answer</summary>
#
# Each of the two terms is bounded: the trace by Ky Fan, the 1-norm of a unit column by its 2-norm,
# which is 1.
#
# ```python
# least = np.linalg.eigvalsh(plate)[:4].sum() + 0.2 * 4
# assert least < price(plate, 0.2, modes)
# ```
#
# </details>
#
# **3.** Fit the rotation with half of the points wrong, and then with the wrong ones *agreeing*:
# all rotated by the same other rotation. In which case does the sum of distances still find the
# rotation?
#
# <details><summary>Answer</summary>
#
# In the first. Random errors cancel, so half of the points change little. Errors that agree define
# a second rotation, and the majority wins: with 60 % of such errors the fit finds their rotation.
# Wrong loop closures behave in the same way ([notebook 9](09_wrong_edges.ipynb)).
#
# ```python
# def fitted(seen):
#     X = cp.Variable((3, 3))
#     distances = cp.Problem(cp.Minimize(cp.sum(cp.norm(points @ X - seen, axis=1))))
#     problem = pgo.OrthogonalProblem(distances, rotations=[X])
#     start = problem.point([pgo.project_to_rotations((points.T @ seen)[None])[0]])
#     return solvers.run(solvers.OrthogonalSOC(tolerance=1e-3), problem, start).state.copies[0]
# other = pgo.random_rotations(1, 3, np.random.default_rng(5))[0]
# agreeing = np.vstack([points[:16] @ truth, points[16:] @ other])
# assert degrees(fitted(scan(0.5))) < 3.0 < degrees(fitted(agreeing))
# ```
#
# </details>

# %%
assert residual < 1e-2
assert (np.abs(thresholded) > 1e-9).sum(axis=0).max() < 0.2 * side**2
assert price(plate, 0.2, modes) < 0.8 * price(plate, 0.2, waves)
assert np.isclose(run.objective, price(string, 0.2, by_hand), rtol=1e-3)
assert errors[0.0][1] < 1.0
assert all(squares > 3 * distances for squares, distances in (errors[0.2], errors[0.4]))
assert likeness(components).min() > 0.99 > likeness(principal).min()
assert explained[0] >= explained[1] > 0.97 * explained[0]
assert all(ours <= cut * (1 + 1e-9) for ours, cut in zip(*curves.values(), strict=True))
assert difference < 1e-9
assert never > 0.1
assert max(objectives) < 1.2 * min(objectives)
