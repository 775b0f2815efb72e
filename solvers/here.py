"""A solve in one process, which has the graph. Other places are compared with this one."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pgo_models.certificates.certificate import (
    BoundSource,
    certify_at,
    certify_with,
    judge,
    with_terms,
)
from pgo_models.certificates.lower_bound import NO_BOUND
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.initialization import chordal_start, spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from pgo_models.relaxations.rounding import round_factor
from solvers.handedness.complex_relaxation import (
    ComplexRelaxation,
    ComplexState,
    certificates_of_relaxation,
)
from solvers.handedness.hull_lagrangian import HullLagrangian, HullState
from solvers.handedness.search import HandednessSearch, stage_of_search, terms_can_help
from solvers.place import BROKEN_OFF, Attempt, OwnStart, Place, Step, Traits, after_search
from solvers.result import History, Outcome, Record, Run, Stage, Status
from solvers.riemannian.newton import Newton
from solvers.riemannian.other_starts import KINDS_OF_STARTS, best_of_starts
from solvers.riemannian.polish import polish
from solvers.riemannian.prefixes import GrowingStart, entry_tree
from solvers.riemannian.shrunk_bound import with_shrunk_information
from solvers.riemannian.staircase import DualBound, Staircase, StaircaseState
from solvers.soc.paper import PaperSOC
from solvers.soc.soc import SOC

if TYPE_CHECKING:  # what a plain solve does not need
    from solvers.robust.gnc import GNC, Inliers

# Poses from which SOC gives the memory of its factor up: a fifth of the most that a solve takes.
MANY_POSES = 20_000


@dataclass(frozen=True, eq=False)
class Here(Place):
    """A solve of a problem in this process, to a relative `gap`.

    `where` is added to the names of searches, where robots leave these to one process.
    """

    problem: PGOProblem
    gap: float
    where: str = ""

    @property
    def traits(self) -> Traits:
        """What the page asks about the graph and its cost."""
        problem = self.problem
        return Traits(
            d=problem.d,
            num_poses=problem.num_poses,
            num_bodies=len(problem.graph.bodies),
            has_translations=problem.has_translations,
            is_quadratic=problem.convex_part is problem,
            is_chi2=problem.weighting is Weighting.INFORMATION,
            averages=problem.d == 2,
            has_landmarks=len(problem.graph.landmarks) > 0,
        )

    def start(self, start: Poses | OwnStart, soc: SOC | PaperSOC | None) -> Attempt:
        """Take the given start, or find one; the monitor shows which stages will follow."""
        began = time.perf_counter()
        problem = self.problem
        name = start.value if isinstance(start, OwnStart) else "given start"
        between = [] if soc is None else [type(soc).__name__]
        self.monitor.plan[:] = [name, *between, Newton.__name__, "certificate"]
        with self.monitor.showing(name, problem.side):
            if not isinstance(start, OwnStart):
                poses = problem.seen_poses(start)
            elif start is OwnStart.TREE:
                poses = spanning_tree_start(problem.convex_part.graph)
            else:
                poses = chordal_start(problem.convex_part, start is OwnStart.AVERAGED)
        seconds = time.perf_counter() - began
        objective = problem.objective(poses)
        self.table.add(Stage(name, Status.CONVERGED, 0, objective, seconds, History()))
        self.monitor.poses_found.append(poses)
        return Attempt(poses)

    @property
    def odometry_joins(self) -> bool:
        """Whether every pose but the first has an edge to an earlier one."""
        return entry_tree(self.problem.graph) is not None

    def run_soc(self, attempt: Attempt, soc: SOC | PaperSOC) -> Attempt:
        """Run SOC on the convex part of the problem.

        The given poses stay where they cost less in that part. This happens: on the data set CSAIL
        the chordal start costs less than every iterate of SOC.
        """
        problem = self.problem
        convex_part = problem.convex_part
        poses = attempt.known_poses
        finished: Run[Any] = self.monitor.run(soc, convex_part, poses)
        if finished.objective <= convex_part.objective(poses):
            poses = finished.poses
        stage = Stage.of(finished)
        if convex_part is not problem:
            objective = problem.objective(poses)
            stage = replace(stage, name=f"{stage.name}, convex", objective=objective)
        self.table.add(stage)
        del finished  # its state has the factor, and Newton's is far larger
        if problem.num_poses > MANY_POSES:
            problem.analysis.release_memory()
        return replace(attempt, poses=poses, status=stage.status)

    def run_newton(self, attempt: Attempt, newton: Newton) -> Attempt:
        """Run Newton from the poses."""
        finished = self.monitor.run(newton, self.problem, attempt.known_poses)
        self.table.add(Stage.of(finished))
        decrement = finished.state.polish.decrement
        return replace(attempt, poses=finished.poses, status=finished.status, decrement=decrement)

    def certify(self, attempt: Attempt) -> Attempt:
        """Find the dual certificate at the poses as they are."""
        poses = attempt.known_poses
        with self.monitor.showing("certificate", self.problem.side):
            deadline = self.proof_deadline(attempt)
            certificate = certify_at(self.problem, poses, self.gap, attempt.decrement, deadline)
        return replace(attempt, certificate=certificate)

    def run_gnc(self, gnc: GNC, start: Poses | None) -> Inliers:
        """Run graduated non-convexity."""
        from solvers.robust.gnc import Inliers

        finished = self.monitor.run(gnc, self.problem, start)
        state = finished.state
        stage = replace(Stage.of(finished), objective=state.objective)
        return Inliers(finished.poses, state.inliers, state.schedule.scale, stage)

    def better(self, best: Attempt, other: Attempt) -> Attempt:
        """Return the cheaper poses with the best bound: of either, or of the relaxation."""
        # A cost below zero is zero but for rounding.
        is_cheaper = max(other.proof.poses_objective, 0.0) < best.proof.objective
        cheaper = other if is_cheaper else best
        poses = other.proof.poses if is_cheaper else best.known_poses
        highest = max(best.proof, other.proof, key=lambda known: known.lower_bound)
        judged = judge(self.problem, poses, highest)
        judged = replace(judged, stationarity=cheaper.proof.stationarity)
        dual = other.dual_bound
        if dual is not None and not judged.is_certified:
            relaxed = certify_with(
                self.problem,
                poses,
                dual.Lambda,
                self.gap,
                judged.stationarity,
                BoundSource.RELAXATION,
                dual.bound,
            )
            judged = max(judged, relaxed, key=lambda known: known.lower_bound)
        status = other.status if other.status in BROKEN_OFF else cheaper.status
        decrement = cheaper.decrement
        return replace(best, poses=poses, certificate=judged, status=status, decrement=decrement)

    def start_grown(self, growing: GrowingStart) -> Attempt:
        """Start at poses that prefixes of the graph lead to."""
        finished = self.monitor.run(growing, self.problem)
        self.table.add(replace(Stage.of(finished), name=f"growing start{self.where}"))
        return Attempt(finished.poses, status=finished.status)

    def try_other_starts(self, best: Attempt, newton: Newton) -> Attempt:
        """Return the better of the answer and an attempt from the best of some other starts."""
        for name, kind in KINDS_OF_STARTS:
            began = time.perf_counter()
            starts = kind(self.problem, best.known_poses)
            with self.monitor.showing(name, self.problem.side):
                found = best_of_starts(
                    self.problem,
                    starts,
                    best.known_poses,
                    best.proof.objective,
                    self.monitor.deadline,
                )
            if not found.num_tried:
                continue
            is_better = found.poses is not best.known_poses
            if is_better:
                self.table.begin_attempt()
            stage = Stage(
                f"{name}{self.where}: {found.name}",
                Status.CONVERGED,
                found.num_tried,
                found.objective,
                time.perf_counter() - began,
                History(),
                finds_poses=is_better,
            )
            self.table.add(stage)
            if is_better:
                attempt = self.run_newton(Attempt(found.poses), newton)
                best = self.better(best, self.certify(attempt))
            if not best.is_open:
                break
        return best

    def climb(self, best: Attempt, staircase: Staircase) -> Attempt:
        """Run the Riemannian staircase from the best poses, and round its solution.

        Of a run that was cut short the state with the best poses is kept, not the one with the best
        bound: so the bound is that of the last state that was seen.
        """
        bounds: list[DualBound | None] = [None]
        asked = self.monitor.callback

        def remember_bound(state: StaircaseState, record: Record) -> bool | None:
            bounds.append(state.bound)
            return asked(state, record) if asked is not None else None

        monitor = replace(self.monitor, callback=remember_bound)
        finished = monitor.run(staircase, self.problem, best.known_poses)
        self.table.add(Stage.of(finished))
        return Attempt(finished.poses, finished.status, dual_bound=bounds[-1])

    def bound_by_smaller_matrices(self, best: Attempt) -> Attempt:
        """Return the same poses, with the bound of smaller information matrices if it is better."""
        began = time.perf_counter()
        certificate = with_shrunk_information(self.problem, best.proof)
        seconds = time.perf_counter() - began
        name = f"{Step.SMALLER_MATRICES.value}{self.where}"
        objective = certificate.objective
        self.table.add(
            Stage(name, Status.CONVERGED, 0, objective, seconds, History(), finds_poses=False)
        )
        return replace(best, certificate=certificate)

    def solve_in_complex_numbers(self, best: Attempt, method: ComplexRelaxation) -> Attempt:
        """Solve the relaxation with complex numbers, and return the better poses and bound."""
        problem = self.problem
        finished: Outcome[ComplexState] = self.monitor.run(method, problem, best.known_poses)
        stage = stage_of_search(finished)
        self.table.add(replace(stage, name=f"{stage.name}{self.where}"))
        for certificate in certificates_of_relaxation(problem, method, finished.state, self.gap):
            rounded = Attempt(certificate.poses, best.status, certificate=certificate)
            best = self.better(best, rounded)
        return after_search(best, best.proof, stage)

    def terms_can_help(self, best: Attempt) -> bool:
        """Whether terms may raise the bound, of chi2 by the Hessian of its tangent."""
        ground = self.problem.at_best_translations(best.known_poses)
        return terms_can_help(self.problem, ground, best.proof.lower_bound)

    def bound_by_terms(
        self, best: Attempt, search: HandednessSearch, Pi: Array | None = None
    ) -> Attempt:
        """Return the same poses, with the bound of handedness terms if it is better."""
        problem = self.problem
        ground = problem.at_best_translations(best.known_poses)
        terms, stage = search.run(problem, ground, self.monitor, Pi)
        self.table.add(replace(stage, name=f"{stage.name}{self.where}"))
        judged = judge(problem, best.known_poses, best.proof)
        return after_search(best, with_terms(problem, judged, terms, ground), stage)

    def solve_hulls(self, best: Attempt, method: HullLagrangian) -> Attempt:
        """Solve that relaxation, and return the better poses and the better bound."""
        problem = self.problem
        begin = best.known_poses if best.hulls is None else best.hulls
        finished: Outcome[HullState] = self.monitor.run(method, problem, begin)
        stage = stage_of_search(finished)
        self.table.add(replace(stage, name=f"{stage.name}{self.where}"))
        state = finished.state
        if state.bound is not None:
            poses = polish(problem, round_factor(problem, state.point.Y)[0])
            relaxed = certify_with(
                problem,
                poses,
                state.bound.Lambda,
                self.gap,
                math.nan,
                BoundSource.HULLS,
                state.bound.bound,
            )
            best = self.better(best, Attempt(poses, best.status, certificate=relaxed))
        return replace(after_search(best, best.proof, stage), hulls=state)

    @property
    def has_poses(self) -> bool:
        """Whether a start or a run has given poses."""
        return bool(self.monitor.poses_found)

    def salvage(self, reason: Status) -> Attempt:
        """The cheapest poses so far, or those along a spanning tree, with the bound F >= 0."""
        candidates = self.monitor.poses_found or [spanning_tree_start(self.problem.graph)]
        poses = min(candidates, key=self.problem.objective)
        self.table.add(Stage.without_steps(reason, self.problem.objective(poses)))
        return self.without_bound(Attempt(poses, reason))

    def without_bound(self, attempt: Attempt) -> Attempt:
        """Return the attempt with the bound F >= 0, which needs no proof."""
        poses = attempt.known_poses
        certificate = certify_with(
            self.problem,
            poses,
            np.zeros_like(poses.R),
            self.gap,
            attempt.decrement,
            BoundSource.GIVEN,
            NO_BOUND,
        )
        return replace(attempt, certificate=certificate)
