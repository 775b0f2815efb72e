"""The place where robots solve, with a driver: beside the graph of all robots, or without it.

Robots hold the poses between two steps, and an attempt has none until its certificate is found.
Where this process has the whole graph, it collects the poses then, and takes the steps that robots
lack (`PlaceOfRobots.here`). Robots that have read their own files keep the poses of the cheapest
attempt so far. The driver then knows the interface between the robots (`solvers.robots.setup`), and
of the answer its cost and bound. A certificate is of the poses that the robots keep, and has
neither poses nor multipliers itself. A bound holds for all poses, and so belongs to whatever they
keep.

Without a driver there is `solvers.robots.place_without_driver`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from pgo_models.certificates.certificate import (
    BoundSource,
    Certificate,
    certify_with,
    judge_cost,
)
from pgo_models.certificates.fit import Fit
from pgo_models.certificates.handedness import distinct_pairs
from pgo_models.certificates.lower_bound import NO_BOUND, LowerBound
from pgo_models.certificates.rounding_errors import ObjectiveRounding
from pgo_models.errors import PGOError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.initialization import chordal_start, spanning_tree_start
from pgo_models.problem.weighting import Weighting
from solvers.carry.counted_pool import Count
from solvers.carry.faults import Faults
from solvers.carry.ledger import Ledger
from solvers.handedness.ascent import AscentState
from solvers.handedness.complex_relaxation import ComplexRelaxation
from solvers.handedness.hull_lagrangian import HullLagrangian
from solvers.handedness.search import HandednessSearch, stage_of_search
from solvers.here import Here
from solvers.place import (
    BROKEN_OFF,
    AnySOC,
    Attempt,
    Ending,
    OwnStart,
    Place,
    Step,
    Traits,
    after_search,
)
from solvers.result import History, Outcome, Stage, Status
from solvers.riemannian.newton import Newton
from solvers.riemannian.prefixes import GrowingStart
from solvers.riemannian.staircase import Staircase
from solvers.robots.asynchronous import AsynchronousSOC
from solvers.robots.checkpoint import Journal
from solvers.robots.climb import SubstructuredStaircase, round_lifted
from solvers.robots.consensus import ConsensusSOC
from solvers.robots.driver import CoverPoses, Driver, collect
from solvers.robots.handedness import (
    RobotsPoint,
    begin_without_terms,
    hand_out_terms,
    return_to_best,
)
from solvers.robots.newton import SubstructuredNewton
from solvers.robots.own_file import (
    READ_HERE,
    Answer,
    keep_answer,
    move_answer,
    return_to_answer,
)
from solvers.robots.paper import PaperByRobots
from solvers.robots.proof import best_bound_distributed, best_bound_with_terms
from solvers.robots.revision import go_to_poses_found
from solvers.robots.reweigh import SharedGNC, inliers_of
from solvers.robots.soc import SubstructuredSOC
from solvers.robots.translations import reduce_translations
from solvers.robots.trees import tree_traffic
from solvers.robust.gnc import GNC, Inliers
from solvers.robust.known import KnownEdges
from solvers.robust.weighted_edges import first_poses
from solvers.soc.paper import PaperSOC
from solvers.soc.settings import Coupling


@dataclass(frozen=True, eq=False)
class AttemptWithFaults(Attempt):
    """An attempt whose SOC had faults. Rounds are numbered on from those of SOC.

    `offset` is the number of the current round less the rounds on the ledger. For `patience` rounds
    the driver waits for a robot that is silent, and then gives it up.
    """

    offset: int = 0
    patience: int = 0

    def check_heard(self, faults: Faults, rounds: int) -> None:
        """Raise a RobotSilentError where a robot is silent now, and stays silent for too long."""
        faults.check_heard(rounds + self.offset, self.patience)


@dataclass(frozen=True, eq=False)
class KeptAnswer:
    """The cheapest poses so far, which robots with own files keep, as the driver knows them.

    `cover` are the poses of the driver, `status` how the run ended that found them.
    """

    objective: float
    decrement: float
    rounding: ObjectiveRounding
    robots: Sequence[Answer]
    cover: CoverPoses
    status: Status


@dataclass(frozen=True, eq=False)
class PlaceOfRobots(Place):
    """A solve of the graph `name` by robots and their driver, to a relative `gap`.

    Parameters
    ----------
    driver : Driver
        The driver, with the network of its robots.
    journal : Journal
        Checkpoints. Where one is of a later stage, what comes before it is passed over.
    name : str
        Name of the graph.
    gap : float
        The relative gap to certify.
    weighting : Weighting
        The cost that a certificate of what robots keep is of.
    faults : Faults, optional
        What goes wrong between the robots of a CONSENSUS stage, which then does not wait.
    here : Here, optional
        A solve of the graph of all robots in this process, which then takes the steps that robots
        lack. The name of their stages says so.
    owners : Partition, optional
        Who owns which poses of that graph.
    kept : list of KeptAnswer
        Without that graph: the answers that the robots have kept, of which the last is current.
    begins_at : str, optional
        Name of a start at poses that the robots have found before; their own start unless given.
    is_on_the_way : bool
        Whether the map is on the way to another one. Shifts of the bound that cost more than the
        gap are then not tried.
    """

    driver: Driver
    journal: Journal
    name: str
    gap: float
    weighting: Weighting = Weighting.ISOTROPIC
    faults: Faults | None = None
    here: Here | None = None
    owners: Partition | None = None
    kept: list[KeptAnswer] = field(default_factory=list)
    begins_at: str | None = None
    is_on_the_way: bool = False

    # What the page asks

    @property
    def traits(self) -> Traits:
        """Traits of the graph; its rotations are averaged if all robots can average theirs.

        Files with landmarks are refused when robots read them.
        """
        driver = self.driver
        if self.here is not None:
            # The rotation of a loose world depends on positions alone.
            averages = driver.can_average and not self.here.problem.graph.is_world_loose
            return replace(self.here.traits, averages=averages, has_robots=True)
        return Traits(
            d=driver.d,
            num_poses=driver.num_poses,
            num_bodies=driver.num_poses,
            has_translations=driver.has_translations,
            is_quadratic=not driver.has_two_costs,
            is_chi2=driver.has_two_costs,
            averages=driver.can_average,
            has_robots=True,
        )

    @property
    def odometry_joins(self) -> bool:
        """Whether every pose but the first has an edge to an earlier one."""
        return self.here is not None and self.here.odometry_joins

    def lacks(self, step: Step) -> str:
        """Why a step cannot be taken: most need one process with the graph of all robots."""
        if self.here is not None:
            return ""
        if step is Step.SECOND and self.begins_at is not None:
            return "there is no other start"
        return "" if step in (Step.SECOND, Step.STAIRCASE) else "no process has the graph"

    @property
    def way_out(self) -> str:
        """How to have the missing steps taken."""
        return READ_HERE if self.here is None else ""

    @property
    def ledger(self) -> Ledger:
        """What has crossed the network so far."""
        return self.driver.network.ledger

    def finish(self, best: Attempt) -> None:
        """Remove the checkpoint of a solve that has ended well."""
        if best.status.is_success:
            self.journal.end()

    @property
    def known_here(self) -> Here:
        """The solve in this process, where it is known that there is one: see `lacks`."""
        assert self.here is not None
        return self.here

    # An attempt

    def start(self, start: Poses | OwnStart, soc: AnySOC | None) -> Attempt:
        """Start at given poses, at an own start, or at the outcome that a checkpoint has.

        The spanning tree is found in one place, and so is the start of a graph with a loose world.
        Where no process has the graph, nobody could give the poses of all robots.
        """
        known = self._known_outcome()
        if known is not None:
            return known
        if self.begins_at is not None:
            return self._begin(self.begins_at, partial(go_to_poses_found, self.driver))
        if self.here is not None:
            problem = self.here.problem
            if not isinstance(start, OwnStart):
                return self._start_at("given start", problem.seen_poses(start))
            if problem.graph.is_world_loose:
                name = f"{OwnStart.CHORDAL.value}{self.here.where}"
                return self._start_at(name, chordal_start(problem.convex_part))
            if start is OwnStart.TREE:
                name = f"{OwnStart.TREE.value}{self.here.where}"
                return self._start_at(name, spanning_tree_start(problem.convex_part.graph))
        is_averaged = start is OwnStart.AVERAGED
        name = (OwnStart.AVERAGED if is_averaged else OwnStart.CHORDAL).value
        return self._begin(name, partial(self.driver.go_to_chordal_start, is_averaged))

    def _known_outcome(self) -> Attempt | None:
        """Outcome of the attempt that begins, if a checkpoint is of a later one."""
        outcome = self.journal.take_outcome()
        if outcome is None:
            return None
        poses, certificate = outcome
        return Attempt(poses, certificate=certificate)

    def _start_at(self, name: str, poses: Poses) -> Attempt:
        """Bring the robots to poses that this process has."""
        return self._begin(name, partial(self.driver.set_poses, poses))

    def _begin(self, name: str, go_to_start: Callable[[], None]) -> Attempt:
        """Bring the robots to a start."""
        if self.journal.goes_on_with():
            return Attempt()
        driver = self.driver
        driver.choose_cost(final=False)
        began = time.perf_counter()
        with self.monitor.showing(name):
            go_to_start()
            objective = self._final_objective()
            driver.choose_cost(final=False)
        seconds = time.perf_counter() - began
        self.table.add(Stage(name, Status.CONVERGED, 0, objective, seconds, History()))
        return Attempt()

    def run_soc(self, attempt: Attempt, soc: AnySOC) -> Attempt:
        """Run SOC from the current poses, and return to them if its poses cost more."""
        journal = self.journal
        if journal.goes_on_with(SubstructuredNewton):
            return attempt
        driver = self.driver
        began = time.perf_counter()
        if not journal.goes_on_with():
            driver.save_poses()
        finished = self._run_coupling(soc)
        if not driver.current.objective <= driver.saved.objective:
            driver.restore_poses()
        objective = self._final_objective()
        seconds = time.perf_counter() - began
        name = type(soc).__name__
        if driver.is_final:
            name = f"{name}, convex"
        stage = Stage(
            name,
            finished.status,
            finished.iterations,
            objective,
            seconds,
            finished.history,
            soc,
        )
        self.table.add(stage)
        if self.faults is None:
            return replace(attempt, status=finished.status)
        rounds = driver.network.ledger.rounds
        offset = finished.iterations - rounds
        with_faults = AttemptWithFaults(
            status=finished.status, offset=offset, patience=soc.max_iterations
        )
        with_faults.check_heard(self.faults, rounds)
        return with_faults

    def _run_coupling(self, soc: AnySOC) -> Outcome[Any]:
        """Run the coupling that the settings name, or the paper's; its factors go with it."""
        driver = self.driver
        if isinstance(soc, PaperSOC):
            by_paper = PaperByRobots(soc)
            ended = self.journal.run(by_paper, driver, self.monitor)
            by_paper.finish(driver, ended.state)
            return ended
        if soc.effective_coupling is not Coupling.CONSENSUS:
            substructured = SubstructuredSOC(soc)
            finished = self.journal.run(substructured, driver, self.monitor)
            substructured.finish(driver, finished.state)
            return finished
        if self.faults is None:
            consensus = ConsensusSOC(soc)
            waiting = self.journal.run(consensus, driver, self.monitor)
            consensus.finish(driver, waiting.state)
            return waiting
        # No checkpoint can hold the messages that are under way.
        asynchronous = AsynchronousSOC(soc, self.faults)
        impatient = self.monitor.run(asynchronous, driver)
        asynchronous.finish(driver, impatient.state)
        return impatient

    def run_newton(self, attempt: Attempt, newton: Newton) -> Attempt:
        """Run Newton from the current poses."""
        driver = self.driver
        driver.choose_cost(final=True)  # again, where a checkpoint is from before
        finished = self.journal.run(SubstructuredNewton(newton), driver, self.monitor)
        self._add_stage("Newton", finished, newton)
        return replace(attempt, status=finished.status, decrement=finished.state.decrement)

    def _add_stage(self, name: str, finished: Outcome[Any], method: Newton | Staircase) -> None:
        """Write down a run that has ended at the current poses."""
        stage = Stage(
            name,
            finished.status,
            finished.iterations,
            self.driver.current.objective,
            finished.seconds,
            finished.history,
            method,
        )
        self.table.add(stage)

    def _final_objective(self) -> float:
        """The cost that is solved, at the current poses; the driver stays with that cost."""
        self.driver.choose_cost(final=True)
        return self.driver.current.objective

    def certify(self, attempt: Attempt) -> Attempt:
        """Prove the certificate of the current poses by driver and robots.

        Beside the graph the poses are collected, and the whole problem serves for their cost alone.
        Elsewhere the robots keep them if they are the cheapest so far, and the certificate is of
        what the robots keep.
        """
        if self.here is None:
            return self._certify_kept(attempt)
        here = self.here
        with self.monitor.showing("certificate"):
            bound = best_bound_distributed(self.driver, here.gap)
            poses, Lambda = collect(self.driver)
            certificate = certify_with(
                here.problem, poses, Lambda, here.gap, attempt.decrement, BoundSource.GIVEN, bound
            )
        if self.faults is not None and isinstance(attempt, AttemptWithFaults):
            # A robot may have fallen silent since SOC ended.
            attempt.check_heard(self.faults, self.ledger.rounds)
        self.journal.end_attempt((poses, certificate))
        return replace(attempt, poses=poses, certificate=certificate)

    def _certify_kept(self, attempt: Attempt) -> Attempt:
        """Find a bound, and have the robots keep the current poses if these are the cheapest."""
        driver = self.driver
        goes_on = self.is_on_the_way and not attempt.is_out_of_time
        most_lost = self.gap * driver.current.objective if goes_on else None
        bound = best_bound_distributed(driver, self.gap, most_lost)
        source = BoundSource.GIVEN
        dual = attempt.dual_bound
        if dual is not None and dual.lower_bound > bound.value:
            bound = dual.bound
            source = BoundSource.RELAXATION
        if not self.kept or driver.current.objective < self.kept[-1].objective:
            robots = driver.network.ask(keep_answer, driver.poses_of_cover(), Count.ROUND)
            answer = KeptAnswer(
                driver.current.objective,
                attempt.decrement,
                _sum_of_roundings([robot.rounding for robot in robots]),
                robots,
                driver.current,
                attempt.status,
            )
            self.kept.append(answer)
        return replace(attempt, certificate=self._certificate_of_kept(bound, source))

    def _certificate_of_kept(self, bound: LowerBound, source: BoundSource) -> Certificate:
        """Certificate of the poses that the robots keep."""
        kept = self.kept[-1]
        no_poses = Poses.identity(0, self.driver.d)
        judgement = judge_cost(self.name, kept.objective, kept.rounding, bound, self.gap)
        return Certificate(
            objective=judgement.objective,
            bound=judgement.bound,
            gap=judgement.gap,
            rounding_level=kept.rounding.level,
            stationarity=kept.decrement,
            source=source,
            poses=no_poses,
            poses_objective=kept.objective,
            Lambda=no_poses.R,
            wanted_gap=self.gap,
            verdict=judgement.verdict,
            weighting=self.weighting,
            objective_error=kept.rounding.error,
            fit=kept.rounding.fit,
            weights_error=kept.rounding.weights_error,
        )

    def better(self, best: Attempt, other: Attempt) -> Attempt:
        """Return the cheaper poses with the best bound that either has."""
        if self.here is not None:
            return self.here.better(best, other)
        highest = max(best.proof, other.proof, key=lambda known: known.lower_bound)
        certificate = self._certificate_of_kept(highest.bound, highest.source)
        status = other.status if other.status in BROKEN_OFF else self.kept[-1].status
        return replace(best, certificate=certificate, status=status)

    @property
    def has_poses(self) -> bool:
        """Whether the robots have begun, or where no process has the graph, have kept any."""
        return bool(self.kept if self.here is None else self.table.stages)

    def salvage(self, ending: Ending) -> Attempt:
        """The best poses known, those of the robots among them, with the bound F >= 0.

        A PGOError where robots with own files have kept none, as a matrix had no factor before.
        """
        if self.here is not None:
            if ending in (Stage.interruption, Stage.silence):
                self.monitor.poses_found.append(collect(self.driver)[0])
            return self.here.salvage(ending)
        if not self.kept:
            raise PGOError(f"{self.name}: weights too far apart for doubles; see pgo info FILE")
        stage = ending(self.kept[-1].objective)
        self.table.add(stage)
        certificate = self._certificate_of_kept(NO_BOUND, BoundSource.GIVEN)
        return Attempt(status=stage.status, certificate=certificate)

    # Steps after the first attempt

    def start_again(self) -> Poses | None:
        """The optimum of F, found in one place, where the cost is another; else SOC runs again."""
        return None if self.here is None else self.here.start_again()

    def climb(self, best: Attempt, staircase: Staircase) -> Attempt:
        """Have the robots climb the staircase from the best poses, and round its solution."""
        driver = self.driver
        if self.here is not None:
            driver.set_poses(best.known_poses)
        else:
            kept = self.kept[-1]
            driver.network.ask(return_to_answer, [None] * len(kept.robots), Count.PIGGYBACKED)
            driver.current = kept.cover
        self.journal.stop_writing()
        driver.save_poses()
        finished = self.monitor.run(SubstructuredStaircase(staircase), driver)
        if finished.status is Status.INTERRUPTED:
            # Some robots may have one dimension more than others.
            driver.restore_poses()
        else:
            round_lifted(driver)
        self._add_stage("Staircase", finished, staircase)
        return Attempt(status=finished.status, dual_bound=finished.state.bound)

    def start_grown(self, growing: GrowingStart) -> Attempt:
        """Start the robots at poses that prefixes lead to, which are solved in one place."""
        known = self._known_outcome()
        if known is not None:
            return known
        if self.journal.goes_on_with():
            return Attempt()
        grown = self.known_here.start_grown(growing)
        self.driver.choose_cost(final=True)
        self.driver.set_poses(grown.known_poses)
        return Attempt(status=grown.status)

    def bound_by_smaller_matrices(self, best: Attempt) -> Attempt:
        """Try smaller information matrices, in one place."""
        return self.known_here.bound_by_smaller_matrices(best)

    def solve_in_complex_numbers(self, best: Attempt, method: ComplexRelaxation) -> Attempt:
        """Solve the relaxation with complex numbers in one place."""
        return self.known_here.solve_in_complex_numbers(best, method)

    def solve_hulls(self, best: Attempt, method: HullLagrangian) -> Attempt:
        """Solve the relaxation with hulls in one place."""
        return self.known_here.solve_hulls(best, method)

    def bound_by_terms(
        self, best: Attempt, search: HandednessSearch, Pi: Array | None = None
    ) -> Attempt:
        """Return the same poses, with the bound of terms that the robots have of their edges."""
        driver = self.driver
        here = self.known_here
        poses = best.known_poses
        driver.choose_cost(final=True)
        driver.set_poses(poses)
        driver.set_translations(driver.ask(reduce_translations, None, Count.PIGGYBACKED))
        driver.describe(Count.PIGGYBACKED)
        if Pi is None:
            begin_without_terms(driver)
        else:
            hand_out_terms(driver, distinct_pairs(here.problem.graph), poses, Pi)
        first = RobotsPoint.first(driver, search.ascent.num_eigenvalues)
        outcome: Outcome[AscentState[RobotsPoint]] = self.monitor.run(search.ascent, first)
        stage = stage_of_search(outcome)
        self.table.add(stage)
        bound = best_bound_with_terms(driver, here.gap, return_to_best(driver))
        certificate = best.proof
        if bound.value > certificate.bound.value:
            certificate = certify_with(
                here.problem,
                poses,
                collect(driver)[1],
                here.gap,
                certificate.stationarity,
                BoundSource.GIVEN,
                bound,
            )
        return after_search(best, certificate, stage)

    def run_gnc(self, gnc: GNC, start: Poses | None) -> Inliers:
        """Run graduated non-convexity by the robots, which have the thresholds of their edges."""
        assert self.owners is not None
        driver = self.driver
        problem = self.known_here.problem
        if start is None:
            known = KnownEdges.of(problem.graph, gnc.known).edges
            driver.hand_out(first_poses(problem.graph, known))
            for traffic in tree_traffic(problem, self.owners):
                driver.network.ledger = driver.network.ledger.after_round(traffic)
        else:
            driver.hand_out(start)
        driver.choose_cost(final=True)
        finished = self.monitor.run(SharedGNC.of(gnc, driver, problem.graph, has_map=False), driver)
        return inliers_of(problem, gnc, driver, finished)

    def move_to_frame(self, best: Attempt) -> tuple[Attempt, str, float]:
        """Have the robots move the answer to its frame; which that is, and F there.

        A frame far away rounds the poses, so that their cost is found anew: the certificate is of
        the poses that are written.
        """
        kept = self.kept[-1]
        turn, shift, frame = _frame(kept.robots)
        network = self.driver.network
        parts = network.ask(move_answer, [(turn, shift)] * len(kept.robots), Count.ROUND)
        objective = math.fsum(part.cost for part in parts)
        rounding = _sum_of_roundings([part.rounding for part in parts])
        self.kept.append(replace(kept, objective=objective, rounding=rounding))
        certificate = self._certificate_of_kept(best.proof.bound, best.proof.source)
        F = math.fsum(part.F for part in parts)
        return replace(best, certificate=certificate), frame, F


def _sum_of_roundings(parts: Sequence[ObjectiveRounding]) -> ObjectiveRounding:
    """How accurately a sum is known of whose parts that is known."""
    level = math.fsum(part.level for part in parts)
    error = math.fsum(part.error for part in parts)
    weights_error = max(part.weights_error for part in parts)
    return ObjectiveRounding(level, error, Fit.of_all(part.fit for part in parts), weights_error)


def _frame(answers: Sequence[Answer]) -> tuple[Array, Array, str]:
    """Motion (R, t) to the frame of the answer, and which frame that is."""
    first = min(answers, key=lambda answer: (not answer.held[0], answer.held[1]))
    d = first.given.shape[1]
    target = np.concatenate([np.zeros((1, d)), np.eye(d)])
    where = "at the identity"
    if np.isfinite(first.given).all():
        target = first.given
        where = "where its file has it"
    R = target[1:].T @ first.solved[1:]
    t = target[0] - R @ first.solved[0]
    return R, t, f"pose {first.held[2]} {where}"
