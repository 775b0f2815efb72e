# %% [markdown]
# # 12. What does Bregman iteration do to a picture?
#
# Open with `jupyter lab notebooks/12_bregman_on_a_picture.ipynb`;
# `pip install -e '.[notebooks,fast]'` installs it.
#
# - **Prerequisites:** notebooks [2](02_bregman.ipynb) and [3](03_bregman_is_admm.ipynb), which derive
#   Bregman iteration and its alternating form; nothing of robots is needed.
# - **Time:** 30 minutes
# - **Next:** [notebook 13](13_your_own_splitting.ipynb), how to write a splitting method of your own
#
# The paper traces Bregman iteration to total variation in images, which is the subject of this
# notebook. It removes noise from a photograph, recovers the contrast that this costs, fills in
# missing pixels, and ends with a matrix of which a quarter of the entries is unknown. In all four
# problems the work of an iteration is a Fourier transform, a threshold or an SVD. What only draws
# is in [`drawings/bregman_on_a_picture.py`](drawings/bregman_on_a_picture.py).

# %%
import itertools

import cvxpy as cp
import matplotlib.image
import matplotlib.pyplot as plt
import numpy as np
from drawings.bregman_on_a_picture import film_of_iterates, plot_progress, show_pictures
from drawings.checks import NamedNumbers
from matplotlib.cbook import get_sample_data
from scipy.fft import dctn, idctn

import pgo_models as pgo
import solvers
from pgo_models.convex.prox import group_soft_threshold, singular_value_threshold, soft_threshold

plt.rcParams["figure.dpi"] = 110

# %% [markdown]
# The picture is a part of a photograph of Rear Admiral Grace Hopper, which is in the public domain
# and comes with matplotlib. It has 144 times 144 pixels, with values from 0 (black) to 1 (white).
# The noise has a standard deviation of a tenth. How near a picture $u$ is to the true one is
# measured in decibels: $-20 \log_{10}$ of the root mean square error, so that 20 dB is an error of
# 0.1, and every 6 dB more halve it.

# %%
photograph = matplotlib.image.imread(get_sample_data("grace_hopper.jpg", asfileobj=False))
grey = photograph[68:356, 100:388, :3].mean(axis=2) / 255
clean = grey.reshape(144, 2, 144, 2).mean(axis=(1, 3))
rng = np.random.default_rng(0)
noise_std = 0.1
noisy = clean + noise_std * rng.standard_normal(clean.shape)


def root_mean_square(values):
    return np.sqrt(np.mean(values**2))


def decibel(picture):
    return -20 * np.log10(root_mean_square(picture - clean))


# %% [markdown]
# ## Split Bregman, isotropic
#
# Rudin, Osher and Fatemi (1992) compute the picture $u$ near $f$ with the smallest total variation,
# the sum over the pixels of the *length* of the gradient,
#
# $$\min_{u, d} \; \tfrac12 \lVert u - f \rVert^2 + w \sum_p \lVert d_p \rVert_2
#   \quad \text{subject to} \quad D u - d = 0.$$
#
# This is equation (1). One pass over its two blocks before each update of $b$, equation (9), is the
# *split Bregman* method of Goldstein and Osher (2009):
#
# $$\begin{aligned}
#   u &= (I + \alpha D^\top D)^{-1} \bigl(f + \alpha D^\top (d - b)\bigr) \\
#   d_p &= \max(1 - w / (\alpha \lVert v_p \rVert), 0) \, v_p, \quad v = D u + b \\
#   b &\leftarrow b + D u - d
# \end{aligned}$$
#
# The first step is diagonal in Fourier space if $D$ wraps round; the second is a threshold on lengths,
# which is a prox.


# %%
def D(u):
    return np.stack([np.roll(u, -1, 0) - u, np.roll(u, -1, 1) - u], axis=-1)


def D_transposed(p):
    down, right = p[..., 0], p[..., 1]
    return np.roll(down, 1, 0) - down + np.roll(right, 1, 1) - right


def spectrum(shape):  # of D^T D
    rows, columns = (2 - 2 * np.cos(2 * np.pi * np.arange(size) / size) for size in shape)
    return rows[:, None] + columns


# %% [markdown]
# With these, the three steps are the three lines of the loop. `denoised` runs it for a given number
# of iterations.


# %%
def split_bregman(f, weight, alpha):
    """Yields u and the residual ||D u - d||."""
    d = b = np.zeros((*f.shape, 2))
    denominator = 1 + alpha * spectrum(f.shape)
    while True:
        u = np.fft.ifft2(np.fft.fft2(f + alpha * D_transposed(d - b)) / denominator).real
        v = D(u) + b
        d = group_soft_threshold(v, weight / alpha)  # one group a pixel
        b = v - d
        yield u, np.linalg.norm(D(u) - d)


def denoised(f, weight, iterations=40):
    return next(itertools.islice(split_bregman(f, weight, 2.0), iterations - 1, None))


smooth, residual = denoised(noisy, 0.07)
print(f"after 40 iterations ||D u - d|| = {residual:.0e}")
show_pictures(
    [
        (f"noisy, {decibel(noisy):.1f} dB", noisy),
        (f"total variation, {decibel(smooth):.1f} dB", smooth),
    ]
)

# %% [markdown]
# ## The library agrees
#
# The comparison uses a small patch, with $D$ as a matrix, cvxpy for both blocks, and no Fourier
# transform.

# %%
patch = noisy[72:84, 52:64]
basis = np.eye(patch.size).reshape(-1, *patch.shape)
matrix = np.column_stack([D(column).ravel() for column in basis])
u, d = cp.Variable(patch.size), cp.Variable((patch.size, 2))
J = 0.5 * cp.sum_squares(u - patch.ravel()) + 0.07 * cp.sum(cp.norm(d, axis=1))
problem = pgo.BregmanProblem(
    J, (u, d), np.hstack([matrix, -np.eye(2 * patch.size)]), np.zeros(2 * patch.size)
)
states = itertools.islice(
    solvers.iterate(solvers.AlternatingBregman(alpha=2.0, passes=1), problem), 1, 11
)
pairs = zip(states, split_bregman(patch, 0.07, 2.0), strict=False)
difference = max(np.abs(state.x[: patch.size] - mine.ravel()).max() for state, (mine, _) in pairs)
print(f"differs from ours by {difference:.0e} in 10 iterations")

# %% [markdown]
# ## The contrast that total variation removes
#
# The denoised picture has less contrast than the original, because a lower contrast reduces the
# total variation of an edge. In $f - u$ one can see the face. Osher et al. (2005) add it back, by
# equation (4) with $\mathcal{K} = I$: denoise $f + b$ with too *large* a weight,
# add $b \leftarrow b + f - u$, and stop when $\lVert f - u \rVert$ is the size of the noise.


# %%
def bregman_iterates(weight, count):
    b, iterates = np.zeros_like(noisy), []
    for _ in range(count):
        u, _ = denoised(noisy + b, weight, iterations=80)
        b = b + noisy - u
        iterates.append(u)
    return iterates


iterates = bregman_iterates(0.6, 12)
to_data = np.array([root_mean_square(u - noisy) for u in iterates])
quality = np.array([decibel(u) for u in iterates])
stop = int(np.argmax(to_data <= noise_std))
print("||f - u|| a pixel:", to_data.round(3))
print("dB:               ", quality.round(1))
print(f"||f - u|| is at most {noise_std} from iterate {stop + 1} on: {quality[stop]:.1f} dB")

# %% [markdown]
# The film shows the iterates, and below them their distances to the noisy $f$ and to the true
# picture. The weight is so large that the first iterate is a few grey areas, a dark hat and a light
# face. Each iteration adds what comes next in size: the glasses, the mouth, the wrinkles, and from
# the sixth iterate on the noise. The distance to $f$ falls in every iteration, and says nothing by
# itself. The distance to the truth is least in between, at the fifth iterate. Without the truth,
# one stops where the distance to $f$ crosses the dotted line, the size of the noise: at the fourth,
# which is nearly as good.

# %%
film_of_iterates(iterates, noisy, clean, noise_std)

# %% [markdown]
# The weight 0.07 of the first section was chosen with knowledge of the truth, and no other does
# much better. Here any weight that is too large works, and only the size of the noise has to be
# known. Compared with 0.07 this costs 0.4 dB with the weight 0.6, 0.5 dB with 0.15 and 0.8 dB with 2.4.
#
# The next figure shows $f - u$, drawn about a medium grey. The first iterate has lost most of the
# picture; in the fourth nearly all that is taken away is noise.

# %%
show_pictures(
    [(f"f - u of Bregman iterate {k + 1}", 0.5 + 1.5 * (noisy - iterates[k])) for k in (0, stop)]
)

# %% [markdown]
# ## Missing pixels: linearised Bregman beside ISTA and FISTA
#
# Half of the pixels are lost. A photograph has few large coefficients $x$ in a cosine transform, so
# look for the smallest $\lVert x \rVert_1$ with $\mathcal{K} x = f$: $\mathcal{K}$ is the inverse
# transform, restricted to the known pixels. There are two ways:
#
# * *A penalty*, $\min w \lVert x \rVert_1 + \tfrac12 \lVert \mathcal{K} x - f \rVert^2$: ISTA takes
#   a gradient step and a soft threshold, FISTA (which the paper names for its step (a)) from an
#   extrapolated point.
# * *The constraint*: Bregman iteration with the quadratic term linearised (Yin, Osher, Goldfarb,
#   Darbon 2008) is two lines, $v \leftarrow v + \mathcal{K}^\top (f - \mathcal{K} x)$,
#   $x = \delta\, \operatorname{soft}(v, \mu)$. The residuals are *summed* in $v$, as in $b$. It
#   converges to the minimum of $\mu \lVert x \rVert_1 + \tfrac1{2 \delta} \lVert x \rVert^2$ on
#   $\mathcal{K} x = f$.


# %%
seen = rng.random(clean.shape) < 0.5
f = clean * seen


def K(x):
    return idctn(x, norm="ortho") * seen


def K_transposed(y):
    return dctn(y * seen, norm="ortho")


# %% [markdown]
# Each of the three methods is a generator of its iterates. All of them start at $x = 0$.


# %%
def ista(weight):
    x = np.zeros_like(f)
    while True:
        x = soft_threshold(x + K_transposed(f - K(x)), weight)
        yield x


def fista(weight):
    x, y, t = np.zeros_like(f), np.zeros_like(f), 1.0
    while True:
        x_new = soft_threshold(y + K_transposed(f - K(y)), weight)
        t_new = (1 + np.sqrt(1 + 4 * t**2)) / 2
        y = x_new + (t - 1) / t_new * (x_new - x)
        x, t = x_new, t_new
        yield x


def linearised_bregman(mu, delta=1.0):
    x = v = np.zeros_like(f)
    while True:
        v = v + K_transposed(f - K(x))
        x = delta * soft_threshold(v, mu)
        yield x


# %%
def lasso(x, weight):
    return weight * np.abs(x).sum() + 0.5 * np.sum((K(x) - f) ** 2)


steps, weight = 200, 0.002
runs = {
    "ISTA": list(itertools.islice(ista(weight), steps)),
    "FISTA": list(itertools.islice(fista(weight), steps)),
    "linearised Bregman": list(itertools.islice(linearised_bregman(2.0), steps)),
}
pictures = {name: [idctn(x, norm="ortho") for x in xs] for name, xs in runs.items()}
lowest = min(lasso(x, weight) for x in runs["FISTA"])
plot_progress(
    costs={name: [lasso(x, weight) / lowest - 1 + 1e-6 for x in xs] for name, xs in runs.items()},
    qualities={name: [decibel(u) for u in us] for name, us in pictures.items()},
)

# %%
filled = {name: us[-1] for name, us in pictures.items()}
show_pictures(
    [
        ("half of the pixels", f),
        *((f"{name}, {decibel(u):.1f} dB", u) for name, u in filled.items()),
    ]
)

# %% [markdown]
# All three methods do the same work per step: two transforms and a threshold. With such a small
# weight ISTA is very slow, and FISTA needs about sixty steps to catch up. Linearised Bregman has no
# weight that must go to zero, because $v$ still contains everything that $x$ has not yet fitted. It
# begins with the few largest coefficients and adds smaller ones when they are needed, as the scale
# space of [notebook 2](02_bregman.ipynb) does, and shows a face after ten steps. FISTA ends with a
# better picture: linearised Bregman minimises an additional $\lVert x \rVert^2$, whose effect is
# smaller with a larger $\mu$ and more steps.
#
# ## A matrix of which a quarter is missing
#
# Replace coefficients by singular values, and linearised Bregman is *singular value thresholding*
# (Cai, Candes and Shen 2010). For large $\mu$ it converges to the matrix of smallest nuclear norm.
# cvxpy, for which this is a semidefinite program, confirms it.


# %%
def complete(M, known, mu, delta, iterations):
    X = Y = np.zeros_like(M)
    for _ in range(iterations):
        Y = Y + delta * known * (M - X)
        X = singular_value_threshold(Y, mu)
    return X


low_rank = rng.standard_normal((20, 2)) @ rng.standard_normal((2, 16))
known = rng.random(low_rank.shape) < 0.75
completed = complete(low_rank, known, 100.0, 1.5, 3000)
X = cp.Variable(low_rank.shape)
nuclear = cp.Problem(cp.Minimize(cp.normNuc(X)), [cp.multiply(known, X) == known * low_rank])
nuclear.solve(solver=cp.CLARABEL)
print(f"nuclear norm by thresholding {np.linalg.norm(completed, 'nuc'):.5f}")
print(f"             by cvxpy        {nuclear.value:.5f}")
print(f"             of the truth    {np.linalg.norm(low_rank, 'nuc'):.5f}")
largest = np.abs(completed - low_rank)[~known].max()
print(f"largest error in the entries that were missing: {largest:.1e}")

# %% [markdown]
# ## Where it fails
#
# 1. If it continues, Bregman iteration converges to the noisy $f$: its iterates are useful, not its
#    limit.
# 2. Total variation favours flat patches with sharp edges. Where the truth is a ramp, it produces
#    steps.
# 3. With too few entries, the smallest nuclear norm is not the truth. Nothing in the run shows
#    this.

# %%
ramp = np.tile(np.linspace(0.0, 1.0, 64), (16, 1))
stairs, _ = denoised(ramp + 0.1 * rng.standard_normal(64), 0.3, 1000)
levels = np.abs(np.diff(stairs[8, 5:-5]))
print(f"a ramp: {np.mean(levels < 0.1 / 63):.0%} of the steps along a row are flat")
fewer = rng.random(low_rank.shape) < 0.25
guessed = complete(low_rank, fewer, 200.0, 1.5, 3000)
print(f"a quarter of the entries: fits to {np.abs(guessed - low_rank)[fewer].max():.0e}", end=", ")
print(f"off by {np.abs(guessed - low_rank)[~fewer].max():.1f} elsewhere")

# %% [markdown]
# ## Exercises
#
# **1.** What does $\alpha$ change in the denoiser: the answer, the number of iterations, or both?
#
# <details><summary>Answer</summary>
#
# The number of iterations. The problem is strictly convex and has one solution, and the fixed
# points do not depend on $\alpha$.
#
# ```python
# answers = [next(itertools.islice(split_bregman(patch, 0.07, alpha), 4000, None))[0] for alpha in (0.5, 2.0)]
# assert np.abs(answers[0] - answers[1]).max() < 1e-4
# ```
#
# </details>
#
# **2.** Why can linearised Bregman take steps of length 1 here? What must be known of $\mathcal{K}$
# otherwise?
#
# <details><summary>Answer</summary>
#
# The rows of $\mathcal{K}$ are rows of an orthogonal matrix, so
# $\lVert \mathcal{K} \mathcal{K}^\top \rVert = 1$. The method is gradient ascent on a dual function
# whose gradient has the Lipschitz constant $\delta \lVert \mathcal{K} \mathcal{K}^\top \rVert$; the
# step must be below 2 divided by this constant.
#
# ```python
# y = rng.standard_normal(f.shape) * seen
# assert np.allclose(K(K_transposed(y)), y)
# too_long = next(itertools.islice(linearised_bregman(2.0, delta=4.0), 200, None))
# assert np.linalg.norm(K(too_long) - f) > 100 * np.linalg.norm(K(runs["linearised Bregman"][-1]) - f)
# ```
#
# </details>
#
# **3.** What does $f - u$ contain after the first Bregman step, and what after the step at which we
# stopped? Measure how much of it is noise.
#
# <details><summary>Answer</summary>
#
# After the first step it contains much of the picture; after the last step it is nearly all noise.
#
# ```python
# noise = noisy - clean
# share = [np.corrcoef((noisy - u).ravel(), noise.ravel())[0, 1] for u in iterates]
# assert share[0] < 0.85 < share[stop]
# ```
#
# </details>

# %% [markdown]
# ## Checks of the numbers above
#
# Readers who have changed parameters may skip this cell, which holds for those given.

# %%
with NamedNumbers():
    assert decibel(smooth) > decibel(noisy) + 5
    assert residual < 0.1
    assert difference < 1e-5
    assert quality[stop] > quality[0] + 2
    assert quality[stop] > quality[-1]
    assert np.all(np.diff(to_data) <= 0)
    assert quality[stop] > quality.max() - 0.5
    lost = {0.6: decibel(smooth) - quality[stop]}
    for weight_too_large, count in ((0.15, 2), (2.4, 13)):
        last, before_last = bregman_iterates(weight_too_large, count)[:-3:-1]
        assert root_mean_square(last - noisy) <= noise_std < root_mean_square(before_last - noisy)
        lost[weight_too_large] = decibel(smooth) - decibel(last)
    assert np.allclose([lost[0.6], lost[0.15], lost[2.4]], [0.4, 0.5, 0.8], atol=0.05)
    assert (stop, int(np.argmax(quality))) == (3, 4)
    assert lasso(runs["FISTA"][50], weight) < lasso(runs["ISTA"][50], weight)
    assert min(decibel(u) for u in filled.values()) > decibel(f) + 5
    assert np.linalg.norm(K(runs["linearised Bregman"][-1]) - f) < 1e-2 * np.linalg.norm(f)
    assert np.isclose(np.linalg.norm(completed, "nuc"), nuclear.value, rtol=1e-3)
    assert np.abs(completed - low_rank).max() < 1e-2
    assert np.mean(levels < 0.1 / 63) > 0.5
    assert np.abs(guessed - low_rank)[fewer].max() < 0.05 < np.abs(guessed - low_rank)[~fewer].max()
