# %% [markdown]
# # 15. How does one average rotations?
#
# Open with `jupyter lab notebooks/15_rotation_averaging.ipynb`;
# `pip install -e '.[notebooks,fast]'` installs it.
#
# * **Prerequisites:** matrices and eigenvectors; for the certificate
#   [notebook 1](01_quickstart.ipynb) or [notebook 14](14_is_it_really_the_best.ipynb)
# * **Time:** 20 minutes
# * **Next:** [notebook 16](16_beyond_the_relaxation.ipynb), what can be proven where the relaxation is
#   loose
#
# Some devices measure rotations and nothing else: cameras that see the same things from different
# sides, gyroscopes, particles in an electron microscope. The rotations are unknown, what is measured is how some of
# them differ, and the measurements contradict each other. This is *rotation averaging*. It is also the
# hard part of pose graph optimisation, for if the rotations are known, the positions solve a linear
# system. We average by hand, one rotation first, then a loop, then a graph, and prove that the
# result is the best.

# %%
import itertools

import numpy as np
from drawings.checks import NamedNumbers
from drawings.rotation_averaging import film_of_arrows, plot_noise

import pgo_models as pgo
import solvers

# %% [markdown]
# ## Several measurements of one rotation
#
# The mean of 350 degrees and 10 degrees is not 180 degrees. In space angles are worse still. So we say
# what the mean should do: be the rotation with the least sum of squared distances to the measured
# ones. With $\lVert R \rVert_F^2 = d$ for every rotation,
#
# $$\sum_k \kappa_k \lVert R - R_k \rVert_F^2 = 2 d \sum_k \kappa_k - 2 \operatorname{tr}(R^\top C),
#   \qquad C = \sum_k \kappa_k R_k .$$
#
# So we need the rotation with the largest $\operatorname{tr}(R^\top C)$. It depends only on the weighted sum
# $C$ of matrices, which is no rotation itself. A singular value decomposition $C = U \Sigma V^\top$ gives the answer,
# $R = U V^\top$; where this has the determinant $-1$, the last column of $U$ changes its sign.


# %%
def nearest_rotation(C):
    U, _, Vt = np.linalg.svd(C)
    signs = np.ones(len(C))
    signs[-1] = np.sign(np.linalg.det(U @ Vt))
    return U * signs @ Vt


rng = np.random.default_rng(0)
truth = pgo.random_rotations(1, 3, rng)[0]
measured = truth @ pgo.exp_map(rng.normal(0.0, np.deg2rad(20), (40, 3)))


def degrees_between(A, B):
    return np.rad2deg(np.linalg.norm(pgo.log_map(np.swapaxes(A, -1, -2) @ B), axis=-1))


C = measured.mean(axis=0)
mean = nearest_rotation(C)
single_errors = degrees_between(truth, measured)
mean_error = degrees_between(truth, mean)
print(f"a single measurement is off by {single_errors.mean():.1f} degrees on average")
print(f"the mean of {len(measured)} is off by {mean_error:.1f} degrees")
print(f"determinant of C {np.linalg.det(C):.3f}, of the mean {np.linalg.det(mean):.3f}")

# %% [markdown]
# The determinant of $C$ is below one: the sum of rotations has shrunk, and the more so the more they
# scatter. Projecting it is all that is needed. The library's `pgo.project_to_rotations` does the same for
# many matrices at once.
#
# ## A loop, with pen and paper
#
# Now $n$ poses in the plane stand in a ring, and each measures by which angle $a_i$ the next one is
# turned. Around the ring the true angles add up to a multiple of 360 degrees. The measured ones do not:
# they leave an error $e$. An edge whose residual is $r$ degrees costs $4 \kappa (1 - \cos r)$. By symmetry,
# with equal weights, the best is that every edge takes its share, $r = e / n$, and
#
# $$F = 4 \kappa\, n\, (1 - \cos(e / n)) .$$
#
# But there is more than one way to share. The residuals may also add up to $e + 360\, w$ degrees, where the
# whole number $w$ says how often the answer winds around in addition. Every $w$ for which the share
# $(e + 360\, w) / n$ is below 90 degrees is a *local minimum*: no small change lowers the cost.

# %%
count = 24
rng = np.random.default_rng(3)
heading = 2 * np.pi * np.arange(count) / count + np.pi / 2  # along the ring
facing = pgo.exp_map(heading[:, None])
i, j = np.arange(count), (np.arange(count) + 1) % count
noise = rng.normal(0.0, np.deg2rad(15), (count, 1))
ring = pgo.PoseGraph(
    num_poses=count,
    i=i,
    j=j,
    R_ij=np.swapaxes(facing[i], 1, 2) @ facing[j] @ pgo.exp_map(noise),
    t_ij=np.zeros((count, 2)),
    kappa=np.ones(count),
    tau=np.zeros(count),  # no translations are measured
    name="ring of rotations",
)
angles = pgo.log_map(ring.R_ij)[:, 0]
e = (angles.sum() + np.pi) % (2 * np.pi) - np.pi  # between -180 and 180 degrees
by_hand = {w: 4 * count * (1 - np.cos((e + 2 * np.pi * w) / count)) for w in (-2, -1, 0, 1, 2)}
print(f"the loop fails to close by {np.rad2deg(e):.1f} degrees")
for w, value in by_hand.items():
    print(f"w = {w:2}: F = {value:.4f}")

# %% [markdown]
# ## A graph: ask the neighbours
#
# In general any pairs of poses are measured, $R_{ij} \approx R_i^\top R_j$, and the cost is the rotation
# part of the paper's equation (16),
#
# $$F(R) = \sum_{(i, j)} \kappa_{ij} \lVert R_j - R_i R_{ij} \rVert_F^2, \qquad R_i \in \mathrm{SO}(d).$$
#
# Hold all rotations but $R_j$. Each neighbour $i$ says what it thinks of it, $R_i R_{ij}$, or
# $R_k R_{jk}^\top$ where the measurement goes the other way. The best $R_j$ is the mean of these opinions, which
# we have just learned to compute. Ask all poses one after the other, and do it again. No step
# increases $F$.


# %%
def sweep(graph, R):
    R = R.copy()
    for pose in range(graph.num_poses):
        opinions = np.zeros((graph.d, graph.d))
        for e in np.flatnonzero(graph.j == pose):
            opinions += graph.kappa[e] * R[graph.i[e]] @ graph.R_ij[e]
        for e in np.flatnonzero(graph.i == pose):
            opinions += graph.kappa[e] * R[graph.j[e]] @ graph.R_ij[e].T
        R[pose] = nearest_rotation(opinions)
    return R


def cost(graph, R):
    residual = R[graph.j] - R[graph.i] @ graph.R_ij
    return np.sum(graph.kappa * np.sum(residual**2, axis=(1, 2)))


def sweeps(graph, R, most=100):
    iterates = [R]
    while len(iterates) <= most:
        iterates.append(sweep(graph, iterates[-1]))
    return iterates


# %% [markdown]
# The same 24 poses, now with 40 measured pairs across the ring besides those around it, all with
# an error of 15 degrees. We begin with random rotations. Move the slider: neighbours agree first, then
# larger and larger parts of the ring do. (The pictures come from
# [`drawings/rotation_averaging.py`](drawings/rotation_averaging.py).)


# %%
def graph_of_pairs(rotations, pairs, std, rng):
    """Measurements of these pairs of rotations, with noise of so many radians for each axis."""
    i, j = pairs.T
    n, d, _ = rotations.shape
    errors = rng.normal(0.0, std, (len(pairs), 1 if d == 2 else 3))
    return pgo.PoseGraph(
        num_poses=n,
        i=i,
        j=j,
        R_ij=np.swapaxes(rotations[i], 1, 2) @ rotations[j] @ pgo.exp_map(errors),
        t_ij=np.zeros((len(pairs), d)),
        kappa=np.ones(len(pairs)),
        tau=np.zeros(len(pairs)),
        name="rotations",
    )


def random_pairs(n, across, rng):
    """A ring of n poses, and so many other pairs."""
    around = np.column_stack([np.arange(n), (np.arange(n) + 1) % n])
    others = np.array([(a, b) for a in range(n) for b in range(a + 2, n) if b - a < n - 1])
    return np.concatenate([around, rng.choice(others, across, replace=False)])


graph = graph_of_pairs(facing, random_pairs(count, 40, rng), np.deg2rad(15), rng)
iterates = sweeps(graph, pgo.random_rotations(count, 2, rng))
costs = [cost(graph, R) for R in iterates]
film_of_arrows(graph, iterates[:13], costs[:13], facing)

# %% [markdown]
# ## A start that needs no luck: eigenvectors
#
# $F$ is quadratic in the entries of the rotations. Stack the $R_i^\top$ in a matrix $Y$ with $d$ columns.
# Then $F = \operatorname{tr}(Y^\top L Y)$, where $L$ is the *connection Laplacian*. Its blocks are easily
# written down: an edge adds $\kappa I$ to the diagonal blocks of $i$ and $j$, and $-\kappa R_{ij}$ to
# block $(i, j)$, its transpose to $(j, i)$.


# %%
def connection_laplacian(graph):
    n, d = graph.num_poses, graph.d
    blocks = np.zeros((n, d, n, d))
    for e in range(graph.num_edges):
        i, j, kappa = graph.i[e], graph.j[e], graph.kappa[e]
        blocks[i, :, i] += kappa * np.eye(d)
        blocks[j, :, j] += kappa * np.eye(d)
        blocks[i, :, j] -= kappa * graph.R_ij[e]
        blocks[j, :, i] -= kappa * graph.R_ij[e].T
    return blocks.reshape(n * d, n * d)


def stacked(R):
    return np.swapaxes(R, 1, 2).reshape(-1, R.shape[2])


L = connection_laplacian(graph)
Y = stacked(iterates[-1])
print(f"tr(Y^T L Y) = {np.trace(Y.T @ L @ Y):.6f}, F = {costs[-1]:.6f}")

# %% [markdown]
# Without noise $L Y = 0$ for the true rotations: $L$ has $d$ eigenvalues zero, and their
# eigenvectors *are* the rotations. With noise we take the eigenvectors of the $d$ smallest
# eigenvalues. This is a relaxation: instead of $d \times d$ blocks that are rotations, each for itself,
# we only ask for $Y^\top Y = n I$, which holds for the sum of all blocks. Then each block is projected.
# All eigenvectors together may come out mirrored; this is seen from the determinants.
#
# The relaxation also gives a lower bound for nothing: the minimum over more matrices is
# $n (\lambda_1 + \dots + \lambda_d)$, so no rotations cost less.


# %%
def spectral_start(graph):
    n, d = graph.num_poses, graph.d
    values, vectors = np.linalg.eigh(connection_laplacian(graph))
    blocks = np.sqrt(n) * vectors[:, :d].reshape(n, d, d)
    if np.linalg.det(blocks).sum() < 0:
        blocks[:, :, 0] *= -1
    R = np.array([nearest_rotation(block.T) for block in blocks])
    return R, n * values[:d].sum()


start, eigenvalue_bound = spectral_start(graph)
from_start = sweeps(graph, start, most=20)
print(f"lower bound from the eigenvalues {eigenvalue_bound:.4f}")
print(f"F of the spectral start          {cost(graph, start):.4f}")
print(f"after 20 sweeps from there       {cost(graph, from_start[-1]):.10f}")
print(f"after 100 from random rotations  {costs[-1]:.10f}")

# %% [markdown]
# ## The library agrees
#
# If no edge measures a translation, a `PGOProblem` is rotation averaging (`tau` is zero everywhere). For a graph with
# translations `weighting=pgo.Weighting.ROTATIONS` asks for it, and `pgo solve --rotations` on the command line.
# `chordal_start` is a variant of the start above: it holds one rotation at the identity and solves a
# linear system, which is cheaper than eigenvectors. `solve` goes on with Newton's method and ends with
# the certificate.

# %%
problem = pgo.PGOProblem(graph)
solution = solvers.solve(problem)
chordal_cost = problem.objective(pgo.chordal_start(problem))
ring_solution = solvers.solve(ring)
print(f"chordal start {chordal_cost:.4f}, solution {solution.objective:.10f}")
print(f"largest difference of L {np.abs(L - problem.L.toarray()).max():.0e}")
print(f"ring: by hand {by_hand[0]:.10f}, by the library {ring_solution.objective:.10f}")
solution

# %% [markdown]
# ## The certificate
#
# The eigenvalue bound knows only the sum over all poses. With a symmetric matrix $\Lambda_i$ for every
# pose, $\Lambda_i = \operatorname{sym}((L Y)_i R_i)$, it becomes sharp. As $R_i R_i^\top = I$,
#
# $$F = \operatorname{tr}(Y^\top S Y) + \sum_i \operatorname{tr} \Lambda_i, \qquad
#   S = L - \operatorname{blockdiag}(\Lambda),$$
#
# for all rotations. At the best ones $S Y = 0$. If no eigenvalue of $S$ is negative, the first term is
# never negative, and nothing costs less than $\sum \operatorname{tr} \Lambda_i$, which is $F$ there.


# %%
def multipliers_and_S(graph, R):
    n, d = graph.num_poses, graph.d
    L = connection_laplacian(graph)
    LY_R = (L @ stacked(R)).reshape(n, d, d) @ R
    Lambda = (LY_R + np.swapaxes(LY_R, 1, 2)) / 2
    S = L.copy()
    for i in range(n):
        S[d * i : d * i + d, d * i : d * i + d] -= Lambda[i]
    return Lambda, S


Lambda, S = multipliers_and_S(graph, solution.poses.R)
eigenvalues_of_L, eigenvalues_of_S = np.linalg.eigvalsh(L), np.linalg.eigvalsh(S)
trace = np.trace(Lambda, axis1=1, axis2=2).sum()
print("smallest of L:", *(f"{value:9.2g}" for value in eigenvalues_of_L[:5]))
print("smallest of S:", *(f"{value:9.2g}" for value in eigenvalues_of_S[:5]))
print(f"sum of tr Lambda {trace:.10f}, F {solution.objective:.10f}")

# %% [markdown]
# Two eigenvalues of $S$ are zero, up to rounding: turning all poses together does not change $F$. The third
# is far from zero. The library leaves out the rows of one pose, which removes the zeros, and proves by a
# Cholesky factorisation that the rest is positive definite (notebook 1).
#
# ## Where it fails: too much noise
#
# Twenty rotations in space with 40 measured pairs, and more and more noise. The upper picture shows the
# smallest eigenvalues, averaged over four graphs at every level. Those of $S$ are without the three zeros:
# $S Y = 0$, so adding $Y Y^\top$ moves the zeros to $n$ and leaves all others where they are. The lower
# picture shows the share of graphs that are certified by $S$ alone, without the handedness terms of
# [notebook 14](14_is_it_really_the_best.ipynb).


# %%
def under_noise(level, seed):
    """The smallest eigenvalues of L, the next one of S, and whether the graph is certified."""
    rng = np.random.default_rng(seed)
    rotations = pgo.random_rotations(20, 3, rng)
    noisy = graph_of_pairs(rotations, random_pairs(20, 20, rng), np.deg2rad(level), rng)
    solved = solvers.solve(noisy, solvers.Pipeline(handedness=None))
    _, S = multipliers_and_S(noisy, solved.poses.R)
    Y = stacked(solved.poses.R)
    of_L = np.linalg.eigvalsh(connection_laplacian(noisy))[:4]
    return [*of_L, np.linalg.eigvalsh(S + Y @ Y.T)[0], solved.is_certified]


levels = np.array([1.0, 10.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0, 50.0, 60.0, 80.0])
means = np.array(
    [np.mean([under_noise(level, seed) for seed in range(4)], axis=0) for level in levels]
)
of_L, next_of_S, share = means[:, :4], means[:, 4], means[:, 5]
_ = plot_noise(levels, of_L, next_of_S, share)

# %% [markdown]
# Without noise the three smallest eigenvalues of $L$ are zero, and the fourth, in orange, says how well the
# graph is connected. Noise raises the three. The closer they come to the fourth, the less the
# eigenvectors know of the rotations. Well before they reach it, between 35 and 40 degrees, the next
# eigenvalue of $S$ falls below zero, and beyond that these multipliers prove nothing sharp: the
# relaxation is loose. A graph with more edges has a larger fourth eigenvalue and stands more noise. (So
# says theory in space: the relaxation is tight if the residuals are small enough, and how small they
# have to be depends on the connectivity of the graph; Eriksson, Olsson, Kahl and Chin 2018.)
#
# ## Where it fails: a ring that winds
#
# Now the ring without other pairs. We begin with the true rotations, but turn every pose by 30 degrees
# more than the one before, which goes around twice, and disturb all of them.

# %%
twist = 2 * 2 * np.pi * np.arange(count) / count
rng = np.random.default_rng(0)
wound_start = facing @ pgo.exp_map(twist[:, None] + rng.normal(0.0, 0.4, (count, 1)))
wound = sweeps(ring, wound_start, most=200)
wound_costs = [cost(ring, R) for R in wound]
film_of_arrows(ring, wound, wound_costs, facing)

# %% [markdown]
# The sweeps remove the disturbance and keep the windings. Every arrow is at the mean of what its two
# neighbours say, so that nothing moves any more, and most of them point the wrong way. The cost is the one that we
# computed with pen and paper for the loop with $w = -2$. The certificate does not take it for
# the answer, and the eigenvectors do not fall for it: the start they give does not wind.

# %%
_, S_wound = multipliers_and_S(ring, wound[-1])
smallest_wound = np.linalg.eigvalsh(S_wound)[0]
stuck = solvers.certify(ring, pgo.Poses(wound[-1], np.zeros((count, 2))))
unwound, _ = spectral_start(ring)
print(f"F after {len(wound) - 1} sweeps {wound_costs[-1]:.8f}, by hand {by_hand[-2]:.8f}")
print(f"smallest eigenvalue of S there {smallest_wound:.3f}")
print(f"gap {stuck.gap:.4f}, {stuck.verdict.name}")
print(
    f"F of the spectral start {cost(ring, unwound):.4f}, the best is {ring_solution.objective:.4f}"
)

# %% [markdown]
# ## Exercises
#
# **1.** For how many whole numbers $w$ does the ring above have a local minimum?
#
# <details><summary>Answer</summary>
#
# For those with $|e + 360\, w| / n < 90$ degrees, where the cost of every edge is convex in its angle.
# There are twelve.
#
# ```python
# shares = (e + 2 * np.pi * np.arange(-20, 21)) / count
# assert np.sum(np.abs(shares) < np.pi / 2) == 12
# ```
#
# </details>
#
# **2.** A rotation in the plane was measured twice, and the measurements differ by 180 degrees. What is
# their mean?
#
# <details><summary>Answer</summary>
#
# There is none that is better than others. $C = R_1 + R_2 = 0$, and $\operatorname{tr}(R^\top C) = 0$ for every
# $R$. The smaller the singular values of $C$, the less the mean is determined.
#
# ```python
# opposite = pgo.exp_map(np.array([[0.3], [0.3 + np.pi]]))
# assert np.allclose(opposite.sum(axis=0), 0)
# candidates = pgo.random_rotations(50, 2, np.random.default_rng(0))
# squares = np.sum((candidates[:, None] - opposite) ** 2, axis=(1, 2, 3))
# assert np.allclose(squares, squares[0])
# ```
#
# </details>
#
# **3.** Measure the pairs of the graph without noise. What is the cost of the spectral start, and what are
# the smallest eigenvalues of $L$?
#
# <details><summary>Answer</summary>
#
# The start is exact, and two eigenvalues are zero.
#
# ```python
# pairs = np.column_stack([graph.i, graph.j])
# exact = graph_of_pairs(facing, pairs, 0.0, np.random.default_rng(0))
# exact_start, exact_bound = spectral_start(exact)
# assert cost(exact, exact_start) < 1e-20
# assert abs(exact_bound) < 1e-10
# assert np.linalg.eigvalsh(connection_laplacian(exact))[2] > 1
# ```
#
# </details>

# %% [markdown]
# ## Checks of the numbers above
#
# This cell is for the tests of the library; if you have changed parameters, you may skip it.

# %%
with NamedNumbers():
    assert np.allclose(mean, pgo.project_to_rotations(C[None])[0])
    assert mean_error < 0.5 * single_errors.mean()
    assert np.linalg.det(C) < 0.9
    assert np.isclose(by_hand[0], ring_solution.objective, rtol=1e-9)
    assert all(after <= before + 1e-9 for before, after in itertools.pairwise(costs))
    assert np.isclose(costs[-1], solution.objective, rtol=1e-9)
    assert np.isclose(cost(graph, from_start[-1]), solution.objective, rtol=1e-9)
    assert eigenvalue_bound <= solution.objective <= cost(graph, start)
    assert np.isclose(np.trace(Y.T @ L @ Y), costs[-1])
    assert np.allclose(L, problem.L.toarray())
    assert np.isclose(cost(graph, solution.poses.R), solution.objective)
    assert solution.is_certified
    assert ring_solution.is_certified
    assert np.abs(eigenvalues_of_S[:2]).max() < 1e-8 < 1 < eigenvalues_of_S[2]
    assert np.allclose(Lambda, pgo.multipliers(problem, solution.poses), atol=1e-8)
    assert np.isclose(trace, solution.objective)
    assert share[0] == 1.0
    assert share[-1] == 0.0
    assert next_of_S[0] > 0.5
    assert next_of_S[-1] < 0.1
    assert of_L[0, 2] < 0.01 < 0.5 < of_L[0, 3]
    assert np.isclose(wound_costs[-1], by_hand[-2], rtol=1e-6)
    assert stuck.gap > 0.99
    assert smallest_wound < -0.1
    assert cost(ring, unwound) < 2 * ring_solution.objective + 0.1
