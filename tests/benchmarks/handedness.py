"""What handedness terms prove, and the relaxation with hulls of rotations beside the plain one.

    python tests/benchmarks/handedness.py            # all tables
    python tests/benchmarks/handedness.py chi2       # chi2 of noisy spheres with stiff axes
    python tests/benchmarks/handedness.py hulls      # relaxations of the paper's scenes
    python tests/benchmarks/handedness.py lattices   # lattices that are too large for their models
    python tests/benchmarks/handedness.py plane      # rotations of the plane as complex numbers

CPU seconds are of one thread.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np

import pgo_models as pgo
import solvers
from pgo_models import Poses, exp_map
from pgo_models.certificates.certificate import with_terms
from pgo_models.certificates.handedness import closed_form_terms
from pgo_models.graphs.precisions import edge_precisions
from solvers import SweptScene
from solvers.riemannian.shrunk_bound import bound_by_shrinking
from solvers.studies.tightness import noisy_lattice, noisy_scene

T = TypeVar("T")
SHARE_STIFF = 0.05  # of the edges
STIFFNESS = 5.0  # how many times better a stiff edge knows its first axis
SPHERES = [(10, 20, 12.0), (44, 50, 8.0), (44, 50, 12.0)]  # rings, poses a ring, degrees of noise
LATTICES = [(6, 30, 0), (6, 40, 0), (6, 40, 1), (6, 50, 0), (10, 30, 0), (10, 40, 0)]
LOOSE = [
    (SweptScene.GRID, 60, 3),
    (SweptScene.GRID, 60, 0),
    (SweptScene.GRID, 70, 4),
    (SweptScene.CIRCLE, 70, 0),
]


def sphere_with_stiff_axes(
    rings: int, per_ring: int, degrees: float, rng: np.random.Generator
) -> pgo.PoseGraph:
    """Poses on a sphere of 10 m, some edges of which know one axis of rotation better."""
    ring, place = np.divmod(np.arange(rings * per_ring), per_ring)
    polar = np.pi * (ring + 0.5) / rings
    azimuth = 2.0 * np.pi * place / per_ring
    across = 10.0 * np.sin(polar)
    t = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), 10.0 * np.cos(polar)], axis=1)
    R = exp_map(azimuth[:, None] * np.array([0.0, 0.0, 1.0]))
    n = len(t)
    i = np.concatenate([np.arange(n - 1), np.arange(n - per_ring)])
    j = np.concatenate([np.arange(1, n), np.arange(per_ring, n)])
    m = len(i)
    deviations = np.full((m, 3), np.deg2rad(degrees))
    deviations[rng.random(m) < SHARE_STIFF, 0] /= STIFFNESS
    information = np.zeros((m, 6, 6))
    information[:, :3, :3] = 25.0 * np.eye(3)
    information[:, 3:, 3:] = np.eye(3) / deviations[:, None, :] ** 2
    turns = exp_map(deviations * rng.standard_normal((m, 3)))
    R_ij = np.swapaxes(R[i], 1, 2) @ R[j] @ turns
    t_ij = np.einsum("mba,mb->ma", R[i], t[j] - t[i]) + 0.2 * rng.standard_normal((m, 3))
    kappa, tau = edge_precisions(information)
    truth = Poses(R, t)
    return pgo.PoseGraph(n, i, j, R_ij, t_ij, kappa, tau, information=information, truth=truth)


def timed(act: Callable[[], T]) -> tuple[T, float]:
    """What a function returns, and its CPU seconds."""
    began = time.process_time()
    found = act()
    return found, time.process_time() - began


def print_chi2() -> None:
    """A row a sphere: the gap with smaller information matrices, and with terms."""
    print("| poses / edges | degrees | stiff edges | gap, smaller matrices | s | gap, terms | s |")
    print("|---|---|---|---|---|---|---|")
    for rings, per_ring, degrees in SPHERES:
        graph = sphere_with_stiff_axes(rings, per_ring, degrees, np.random.default_rng(0))
        problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.INFORMATION)
        poses = solvers.solve(problem).poses
        chi2 = problem.objective(poses)
        shrunk, shrunk_seconds = timed(partial(bound_by_shrinking, problem, poses))
        certificate = pgo.certify_at(problem, poses)
        best = problem.at_best_translations(poses)
        terms = closed_form_terms(problem.tangent_at(best), best)
        assert terms is not None
        _, seconds = timed(partial(with_terms, problem, certificate, terms, best))
        print(
            f"| {graph.num_poses} / {graph.num_edges} | {degrees:g} | {terms.num_pairs} "
            f"| {1 - shrunk.bound.value / chi2:.1e} | {shrunk_seconds:.2f} "
            f"| {certificate.proven_gap:.1e} | {seconds:.2f} |"
        )


def print_hulls() -> None:
    """A row a graph and relaxation: value, rank, rounded poses and CPU seconds."""
    print("| graph | F of `solve` | relaxation | value | bound | rank | F rounded | CPU s |")
    print("|---|---|---|---|---|---|---|---|")
    forms = (
        pgo.RelaxationForm.DUAL,
        pgo.RelaxationForm.HULL_DUAL,
    )
    for scene, degrees, seed in LOOSE:
        graph = noisy_scene(scene, np.deg2rad(degrees), np.random.default_rng(seed))
        problem = pgo.PGOProblem(graph)
        F = solvers.solve(problem).objective
        for form in forms:
            relaxed, seconds = timed(partial(pgo.solve_relaxation, problem, form))
            print(
                f"| {scene.value}, {degrees} degrees, seed {seed} | {F:.6g} | {form.name} "
                f"| {relaxed.value:.8g} | {relaxed.lower_bound:.8g} | {relaxed.rank.rank} "
                f"| {relaxed.objective:.8g} | {seconds:.1f} |",
                flush=True,
            )


def print_lattices() -> None:
    """A row a lattice: the gap without and with handedness terms, and CPU seconds of both."""
    print("| poses / edges | degrees | seed | gap, relaxation | CPU s | gap, with terms | CPU s |")
    print("|---|---|---|---|---|---|---|")
    for side, degrees, seed in LATTICES:
        graph = noisy_lattice(side, np.deg2rad(degrees), np.random.default_rng(seed))
        without, seconds = timed(partial(solvers.solve, graph, solvers.Pipeline(handedness=None)))
        solution, more_seconds = timed(partial(solvers.solve, graph))
        print(
            f"| {graph.num_poses} / {graph.num_edges} | {degrees} | {seed} "
            f"| {without.certificate.proven_gap:.1e} | {seconds:.1f} "
            f"| {solution.certificate.proven_gap:.1e} | {more_seconds:.1f} |",
            flush=True,
        )


def print_plane() -> None:
    """A row a level of noise: graphs certified, and the median gap of the others.

    Of the relaxation with matrices the gap is that of its value in cvxpy, the best it can give.
    """
    print("| degrees | certified, matrices | median gap of others | complex numbers | .. | CPU s |")
    print("|---|---|---|---|---|---|")
    for degrees in (20, 30, 45, 60):
        gaps, seconds = [], []
        for seed in range(20):
            rng = np.random.default_rng(seed)
            graph = noisy_lattice(4, np.deg2rad(degrees), rng, d=2, kappa=1.0)
            problem = pgo.PGOProblem(graph)
            solution, took = timed(partial(solvers.solve, problem))
            relaxed = pgo.solve_relaxation(problem)
            of_matrices = max(0.0, 1.0 - relaxed.lower_bound / solution.objective)
            gaps.append((of_matrices, solution.certificate.proven_gap))
            seconds.append(took)
        cells = [str(degrees)]
        for column in np.array(gaps).T:
            is_open = column > 1e-6
            median = f"{np.median(column[is_open]):.1e}" if is_open.any() else ""
            cells += [f"{(~is_open).sum()} of 20", median]
        print(f"| {' | '.join(cells)} | {np.mean(seconds):.3f} |", flush=True)


if __name__ == "__main__":
    tables = {
        "chi2": print_chi2,
        "hulls": print_hulls,
        "lattices": print_lattices,
        "plane": print_plane,
    }
    for name in sys.argv[1:] or tables:
        tables[name]()
        print()
