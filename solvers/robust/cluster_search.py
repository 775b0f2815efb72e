"""Search for the closures to keep: clusters of them are added, removed and exchanged as units.

On a map that has drifted, each right closure of a run costs thousands of thresholds. Once the map
follows all of them together, they cost almost nothing. So a cluster is not judged by its residuals,
but by

    T = min F(edges kept and the cluster) - min F(edges kept).

On a right map T of k right closures is chi^2 with k d (d + 1) / 2 degrees of freedom to first
order, however far the map moves. A cluster is added if T is at most the quantile 0.99 times the
scale s of the errors. A kept cluster is removed if its T is beyond what chance explains, even if a
large one then costs more in the truncated cost of `revision`. That cost decides on exchanges.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import BoolArray, log_map
from pgo_models.graphs.bridges import unchecked_bridges
from pgo_models.graphs.edge_groups import EdgeGroups
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.thresholds import FALSE_ALARM
from solvers.robust.candidates import Candidates
from solvers.robust.chains import QUANTILE
from solvers.robust.edge_sets import EdgeSets, with_edges
from solvers.robust.fixes import agreeing_fixes, is_fix
from solvers.robust.linear_search import LinearSearch
from solvers.robust.revision import Fit, inlier_problem, is_held
from solvers.robust.weighted_edges import first_poses

# Probability with which a right edge comes back in the end, where few wrong ones lie between this
# and `QUANTILE`.
_LIKELY_QUANTILE = 0.999
# A cluster is tried if its first-order distance is at most this many times its threshold. Those of
# right clusters of nine graphs at odometry, among nine wrong closures of ten, are 0.95 at most.
_NEAR = 2.0
# Clusters that are tried in a row without success, and how often one of them is.
_MOST_FAILURES = 20
_MOST_TRIALS = 3
# Poses times clusters tried, for a row without success: a trial on a large graph takes longer.
_MOST_WORK = 40_000
# Radians by which a map has drifted that may need another start to follow a cluster. Such a start
# helped in 24 of 850 trials, on ring roads where they were 0.48 to 2.8.
_DRIFTED = 0.25
# Closures kept for every cluster that is added before distances are measured again.
_CLOSURES_PER_CLUSTER = 10
# Clusters that are tried for removal in a row, and rounds of an exchange.
_MOST_REMOVALS = 5
_MOST_ROUNDS = 3
# Rejected clusters up to this many times their thresholds tell how many wrong ones fit by chance;
# so many of them are looked at.
_FAR = 4.0
_MOST_SAMPLED = 100
# If more than this share of the rejected edges lie near a map, their number does not tell how many
# wrong ones lie nearer: 1 in 70 do on cubicle, and all where matrices allow any motion.
_FEW = 0.1


@dataclass(frozen=True, eq=False)
class ClusterSearch:
    """Search among sets of the edges that are not known.

    `new` (m,) are edges that have come since others were decided upon: a run of closures with one
    of them may stand in place of kept ones although it is far from the map. Where `is_single`,
    every edge is a cluster of its own.
    """

    sets: EdgeSets
    new: BoolArray | None = None
    is_single: bool = False

    @cached_property
    def clusters(self) -> EdgeGroups:
        """Clusters of the edges that are not known."""
        if self.is_single:
            return EdgeGroups.singles(np.flatnonzero(~self.sets.known))
        return self.sets.pairs.clusters(self.sets.scale)

    @cached_property
    def linear(self) -> LinearSearch:
        """The search by the linear theory among the same edges."""
        return LinearSearch.of(self.sets)

    @cached_property
    def singly(self) -> ClusterSearch:
        """The search with every edge as a cluster of its own; new edges are left to the runs."""
        return replace(self, new=None, is_single=True)

    def improved(self, kept: BoolArray, poses: Poses) -> Fit:
        """Edges to keep, and their poses, from those of an estimate with the edges `kept`, (m,).

        Clusters and single edges are exchanged until the map is at rest; then any edges are, by the
        linear theory, and the map comes to rest anew.
        """
        fit = self._refined(self.sets.settled(kept, poses))
        while self.sets.has_time():
            exchanged = self.linear.exchanged(fit)
            if exchanged is None:
                break
            other = self._refined(exchanged)
            # The loop ends, as the cost of maps at rest falls strictly. That of `exchanged` does
            # not tell: a map can come to rest by the removal of the very edges that were exchanged
            # for others.
            if not self.sets.is_better(other, fit):
                break
            fit = other
        return fit

    def _refined(self, fit: Fit) -> Fit:
        """The fit at rest, with regard to clusters and then to single edges.

        A cluster may have a wrong edge. Edges that come in a stream are moved in clusters alone, as
        its updates have to be fast.
        """
        fit = self._at_rest(fit)
        if self.new is None and (self.clusters.sizes > 1).any() and self.sets.has_time():
            fit = min(fit, self.singly._at_rest(fit), key=self.sets.cost)
        return fit

    def _at_rest(self, fit: Fit) -> Fit:
        """The fit that no addition, removal or exchange of a cluster improves."""
        best: Fit | None = None
        while True:
            fit = self._with_landmarks_elsewhere(fit)
            fit = self._without_misfits(self._with_clusters(fit))
            exchanged = self._exchanged(fit)
            if exchanged is None:
                return fit
            # The loop ends, as the cost of `best` falls strictly.
            if best is not None and not self.sets.is_better(exchanged, best):
                return fit
            best = fit = exchanged

    def expected_by_chance(self, fit: Fit) -> float:
        """Most wrong edges to expect that fit the map by chance, from those that nearly do.

        Of wrong motions that lie anywhere, those within x times the threshold of their first-order
        distance are to those within it as x^(p / 2) to 1, the ratio of the volumes, with p = 3 or 6
        numbers of a motion. A run of closures under one wrong motion is one such motion. So the
        rejected ones between 1 and x = 4 times, and two standard deviations of their number, tell
        how many are expected below 1 at most. Of more than a hundred, a hundred are looked at.
        """
        [(number, deviation)] = self._numbers_between(fit, 1.0, _FAR)
        return wrong_ones_within(number, deviation, self.sets.motion_dimension)

    def _numbers_between(self, fit: Fit, *multiples: float) -> list[tuple[float, float]]:
        """How many rejected edges lie between each two multiples of their thresholds.

        The multiples go up, and distances are those to first order. Beside each number stands its
        standard deviation, where clusters come by chance, each with all of its edges.
        """
        candidates = self._candidates(fit, multiples[-1])
        chosen = candidates.order[:: len(candidates.order) // _MOST_SAMPLED + 1]
        ratios = candidates.ratios(chosen)
        for_each = len(candidates.order) / max(1, len(chosen))
        numbers = []
        for least, most in itertools.pairwise(multiples):
            sizes = candidates.groups.sizes[chosen[(ratios > least) & (ratios <= most)]]
            deviation = float(np.sqrt(np.sum(sizes**2)))
            numbers.append((for_each * float(sizes.sum()), for_each * deviation))
        return numbers

    def with_likely(self, fit: Fit) -> Fit:
        """The fit with rejected edges beyond their thresholds that are likely right.

        Most errors may be smaller than the matrices claim. Then edges within the claimed errors
        come back, if most of these are right (`_are_likely_within`). Otherwise edges between the
        quantiles 0.99 and 0.999 of their costs come back. Among them are 0.9 % of all right edges;
        fewer wrong ones must be expected there. An edge within its threshold was rejected for
        another reason, and stays rejected.
        """
        if not self.sets.scale > 0.0:  # the edges kept fit exactly
            return fit
        p = self.sets.motion_dimension
        farther, nearer = scipy.special.chdtri(p, [1.0 - _LIKELY_QUANTILE, 1.0 - QUANTILE])
        claimed = 1.0 / self.sets.scale
        if claimed > farther / nearer and self._are_likely_within(fit, claimed):
            return self._with_claimed(fit)
        num_kept = int((fit.kept & ~self.sets.known).sum())
        num_right = (_LIKELY_QUANTILE - QUANTILE) * num_kept
        num_wrong = self.expected_by_chance(fit) * ((farther / nearer) ** (0.5 * p) - 1.0)
        if num_wrong > num_right:
            return fit
        candidates = self.singly._candidates(fit, farther / nearer)
        right_costs = self.sets.right_costs
        most = self.sets.scale * right_costs.thresholds(candidates.groups, _LIKELY_QUANTILE)
        for k in candidates.near(candidates.order[:_MOST_FAILURES], farther / nearer):
            if not self.sets.has_time():
                break
            larger = self._with_cluster(fit, candidates.groups[k], most[k])
            if larger is not None and larger.cost - fit.cost > candidates.thresholds[k]:
                fit = larger
        return fit

    def _are_likely_within(self, fit: Fit, reach: float) -> bool:
        """Whether most rejected edges between 1 and `reach` times their thresholds are right.

        With n edges between `reach` and x = 4 times that, and s their standard deviation, (n + 2 s)
        / (x^(p / 4) - 1) wrong ones are expected within `reach`. The exponent is half of that in
        `expected_by_chance`, as matrices that claim much can allow all translations. It is False,
        too, if more than a tenth of all rejected edges lie within x times `reach`: where few edges
        are rejected, this cannot be told.
        """
        within, beyond = self._numbers_between(fit, 1.0, reach, _FAR * reach)
        number, deviation = within
        num_beyond, deviation_beyond = beyond
        num_rejected = int((~fit.kept).sum())
        if number == 0.0 or number + num_beyond > _FEW * num_rejected:
            return False
        p = self.sets.motion_dimension
        num_wrong = (num_beyond + 2.0 * deviation_beyond) / float(_FAR ** (0.25 * p) - 1.0)
        return number - 2.0 * deviation >= 2.0 * num_wrong

    def _with_claimed(self, fit: Fit) -> Fit:
        """The fit with the rejected edges beyond their thresholds that the matrices allow.

        They are added together. An edge leaves again that costs more than the matrices allow at the
        map with all that are left, until there is none.
        """
        claimed = 1.0 / self.sets.scale
        candidates = self.singly._candidates(fit, claimed)
        added = np.zeros_like(fit.kept)
        for k in candidates.near(candidates.order, claimed, beyond=1.0):
            if not self.sets.has_time():
                return fit
            added[candidates.groups[k]] = True
        larger = self.sets.settled(fit.kept | added, fit.poses)
        # The loop ends, as `added` loses an edge in every round.
        while self.sets.has_time():
            costs = self.sets.problem.edge_costs(larger.poses)
            too_far = added & (costs > claimed * self.sets.allowed)
            if not too_far.any():
                return larger
            added &= ~too_far
            larger = self.sets.settled(fit.kept | added, larger.poses)
        return fit

    # Adding clusters

    def _with_clusters(self, fit: Fit) -> Fit:
        """The fit with the rejected clusters that it can follow, the one of least cost first."""
        trials = np.zeros(len(self.clusters), dtype=int)
        # The loop ends, as the fit has more edges after every round.
        while self.sets.has_time():
            fit = self._with_fitting(fit)
            if not self.sets.has_time():
                break
            larger = self._with_next_clusters(fit, self._candidates(fit), trials)
            if larger is None:
                break
            fit = larger
        return fit

    def _with_fitting(self, fit: Fit) -> Fit:
        """The fit with the clusters whose costs at its poses are within their thresholds.

        Their T is less.
        """
        groups = self.clusters.of_edges(~fit.kept)
        costs = groups.sums(self.sets.problem.edge_costs(fit.poses))
        thresholds = self.sets.scale * self.sets.right_costs.thresholds(groups, QUANTILE)
        fitting = groups.edges[(costs <= thresholds)[groups.group_of]]
        if not len(fitting):
            return fit
        larger = self.sets.settled(with_edges(fit.kept, fitting), fit.poses)
        return larger if self.sets.cost(larger) <= self.sets.cost(fit) else fit

    def _candidates(self, fit: Fit, most: float = _NEAR) -> Candidates:
        """Rejected clusters within `most` times their thresholds to first order, at least."""
        return Candidates.of(self.sets, self.clusters, fit, most)

    def _with_next_clusters(self, fit: Fit, candidates: Candidates, trials: IntArray) -> Fit | None:
        """The fit with the first candidates that pass the test; None if none does.

        So many are added that the map hardly stiffens: one for every ten closures kept, at least
        one. `trials`, a number for every cluster, counts how often it has failed, and is brought up
        to date.
        """
        num_left = max(1, int((fit.kept & ~self.sets.known).sum()) // _CLOSURES_PER_CLUSTER)
        num_failures = 0
        larger: Fit | None = None
        names = candidates.groups.names
        waiting = candidates.order[trials[names[candidates.order]] < _MOST_TRIALS]
        all_near = candidates.near(waiting, _NEAR)
        # The loop ends, as every round takes candidates of which there is a finite number.
        while num_left and num_failures < self._most_failures and self.sets.has_time():
            near = list(itertools.islice(all_near, num_left))
            if not near:
                break
            before = fit if larger is None else larger
            after, failed = self._with_each(before, candidates, near)
            trials[names[failed]] += 1
            num_left -= len(near) - len(failed)
            if len(failed) < len(near):
                larger = after
                num_failures = 0
            num_failures += len(failed)
        return larger

    def _with_each(
        self, fit: Fit, candidates: Candidates, chosen: list[int]
    ) -> tuple[Fit, list[int]]:
        """The fit with the chosen candidates whose T passes the test, and those that fail it.

        If all of them pass together, one solve is enough. Otherwise those within their thresholds
        at the map with all of them are tried on their own, and then the others. If none or all are
        within, each half is tried. A wrong cluster that hides among others is removed later, by its
        own rise of the cost. Candidates that time leaves no trial count as failed.
        """
        if len(chosen) == 1:
            k = chosen[0]
            larger = self._with_cluster(fit, candidates.groups[k], candidates.thresholds[k])
            return (fit, chosen) if larger is None else (larger, [])
        edges = np.concatenate([candidates.groups[k] for k in chosen])
        right = self.sets.right_costs.thresholds(EdgeGroups.of([edges]), QUANTILE)
        threshold = self.sets.scale * float(right[0])
        together = self.sets.settled(with_edges(fit.kept, edges), fit.poses)
        if together.cost - fit.cost <= threshold:
            return together, []
        costs = candidates.groups.sums(self.sets.problem.edge_costs(together.poses))[chosen]
        ratio = costs / candidates.thresholds[chosen]
        nearest_first = np.array(chosen)[np.argsort(ratio, kind="stable")].tolist()
        num_within = int(np.sum(ratio <= 1.0))
        num_first = num_within if 0 < num_within < len(chosen) else len(chosen) // 2
        larger, failed = self._with_each(fit, candidates, nearest_first[:num_first])
        if not self.sets.has_time():
            return larger, [*failed, *nearest_first[num_first:]]
        larger, failed_later = self._with_each(larger, candidates, nearest_first[num_first:])
        return larger, [*failed, *failed_later]

    def _with_cluster(self, fit: Fit, cluster: IntArray, threshold: float) -> Fit | None:
        """The fit with a cluster, if its T is at most the threshold."""
        kept = with_edges(fit.kept, cluster)
        larger = self.sets.settled(kept, fit.poses)
        if larger.cost - fit.cost > threshold and self._has_drifted(fit, cluster):
            start = chordal_start(larger.inliers)
            larger = min(larger, self.sets.settled(kept, start), key=lambda other: other.cost)
        return larger if larger.cost - fit.cost <= threshold else None

    def _has_drifted(self, fit: Fit, cluster: IntArray) -> bool:
        """Whether a map has turned so far between the ends that Newton may end elsewhere."""
        poses = (fit.poses.R, fit.poses.t)
        turn, _ = self.sets.chains.closures(cluster, poses).cycle
        return bool(np.linalg.norm(log_map(turn), axis=1).max() > _DRIFTED)

    # Removing clusters

    def _without_misfits(self, fit: Fit) -> Fit:
        """The fit without the clusters that cost more than chance explains, the worst one first."""
        # The loop ends, as the fit has fewer edges after every round.
        while self.sets.has_time():
            smaller = self._without_worst(fit)
            if smaller is None:
                return fit
            fit = smaller
        return fit

    def _without_worst(self, fit: Fit) -> Fit | None:
        """The fit without the cluster of the largest T over its threshold, if that is above 1."""
        groups = self.clusters.of_edges(fit.kept)
        quantile = 1.0 - FALSE_ALARM / max(1, len(groups))
        thresholds = self.sets.scale * self.sets.right_costs.thresholds(groups, quantile)
        ratio = groups.sums(self.sets.problem.edge_costs(fit.poses)) / thresholds
        worst: Fit | None = None
        largest = 1.0
        for k in np.argsort(-ratio, kind="stable")[:_MOST_REMOVALS].tolist():
            kept = fit.kept.copy()
            kept[groups[k]] = False
            if not is_held(self.sets.problem.graph, kept):
                continue
            smaller = self.sets.settled(kept, fit.poses)
            rise = (fit.cost - smaller.cost) / thresholds[k]
            if rise > largest:
                worst = smaller
                largest = rise
        return worst

    # Exchanging clusters

    def _exchanged(self, fit: Fit) -> Fit | None:
        """A fit of less truncated cost, by a rejected cluster that excludes some of those kept."""
        if not self.sets.has_time():
            return None
        candidates = self._candidates(fit)
        for k in candidates.near(candidates.order[: self._most_failures], _NEAR):
            if not self.sets.has_time():
                return None
            other = self._in_place_of_misfits(fit, candidates.groups[k])
            if self.sets.is_better(other, fit):
                return other
        for run in self._rivals(fit):
            if not self.sets.has_time():
                return None
            # The map can bend between two clusters that contradict each other.
            other = self._without_misfits(self._in_place_of_misfits(fit, run))
            if self.sets.is_better(other, fit):
                return other
        for other in itertools.chain(self._without_bridges(fit), self.aligned_anew(fit)):
            if self.sets.is_better(other, fit):
                return other
        return None

    def _with_landmarks_elsewhere(self, fit: Fit) -> Fit:
        """The fit with each landmark at the best place where one of its poses sees it.

        A wrong sighting that is kept holds its landmark away from where right ones agree that it
        is, and these are far from the map one by one. Truncated costs are compared with the poses
        as they are, so that all landmarks are moved at once.
        """
        problem = self.sets.problem
        graph = problem.graph
        sights = np.flatnonzero(np.isin(graph.j, graph.landmarks))
        if fit.kept[sights].all():
            return fit
        allowed = np.where(self.sets.known, np.inf, self.sets.allowed)
        sights = sights[np.argsort(graph.j[sights], kind="stable")]
        seen = graph.j[sights]
        number = np.arange(len(seen)) - np.searchsorted(seen, seen)
        best = fit.poses
        least = np.full(graph.num_poses, np.inf)
        for k in range(-1, min(_MOST_SAMPLED, int(number.max()) + 1)):  # first where they are
            chosen = sights[number == k]
            i = graph.i[chosen]
            t = fit.poses.t.copy()
            t[graph.j[chosen]] = t[i] + np.einsum("kab,kb->ka", fit.poses.R[i], graph.t_ij[chosen])
            costs = np.minimum(problem.edge_costs(Poses(best.R, t)), allowed)
            of_landmarks = np.bincount(graph.j[sights], costs[sights], graph.num_poses)
            is_best = of_landmarks < least
            least = np.where(is_best, of_landmarks, least)
            best = Poses(best.R, np.where(is_best[:, None], t, best.t))
        if np.array_equal(best.t, fit.poses.t):
            return fit
        return self._within_thresholds(Fit.of(problem, fit.kept, best))

    def _without_bridges(self, fit: Fit) -> Iterator[Fit]:
        """Fits with the largest rejected cluster between two parts in place of their only edge.

        Nothing checks that edge, and other edges between the parts may be far from the map that it
        makes: these fits begin at the chordal start.
        """
        graph = self.sets.problem.graph
        is_bridge = unchecked_bridges(graph, self.sets.known, fit.kept)
        for bridge in np.flatnonzero(is_bridge)[: self._most_failures].tolist():
            kept = fit.kept.copy()
            kept[bridge] = False
            is_far = np.zeros(graph.num_poses, dtype=bool)
            is_far[graph.components(kept)[0]] = True
            groups = self.clusters.of_edges(~fit.kept & (is_far[graph.i] != is_far[graph.j]))
            if not self.sets.has_time():
                return
            if groups.sizes.max(initial=0) > 1:
                kept[groups[int(groups.sizes.argmax())]] = True
                start = chordal_start(inlier_problem(self.sets.problem, kept))
                yield self._within_thresholds(self.sets.settled(kept, start))

    def aligned_anew(self, fit: Fit) -> Iterator[Fit]:
        """Fits with fixes that agree, some of them rejected, in place of all fixes kept.

        A map follows its fixes by a motion as a whole. Near it nothing is seen of others that agree
        on another motion, so these begin at the chordal start.
        """
        graph = self.sets.problem.graph
        fixes = is_fix(graph)
        if not (fixes & ~fit.kept & ~self.sets.known).any():
            return
        groups = agreeing_fixes(self.sets.chains, fixes & ~self.sets.known, self.sets.scale)
        others = np.flatnonzero(groups.have_any(~fit.kept))[: self._most_failures]
        for group in map(groups.__getitem__, others.tolist()):
            kept = with_edges(fit.kept & (self.sets.known | ~fixes), group)
            if not self.sets.has_time():
                return
            if is_held(graph, kept):
                start = chordal_start(inlier_problem(self.sets.problem, kept))
                yield self._within_thresholds(self.sets.settled(kept, start))

    def _rivals(self, fit: Fit) -> Iterator[IntArray]:
        """Rejected runs with new closures that are near odometry, if known edges hold the poses.

        What excludes a kept cluster is far from a map that this has bent. A single closure hardly
        outweighs others.
        """
        if self.new is None or self._at_odometry is None:
            return
        candidates = self._at_odometry
        groups = candidates.groups
        is_rival = (groups.sizes > 1) & groups.have_any(self.new) & ~groups.have_any(fit.kept)
        rivals = candidates.order[is_rival[candidates.order]]
        for k in candidates.near(rivals[: self._most_failures], _NEAR):
            yield groups[k]

    @cached_property
    def _at_odometry(self) -> Candidates | None:
        """Clusters near the map of the known edges; None where these do not hold the poses."""
        graph = self.sets.problem.graph
        if not is_held(graph, self.sets.known):
            return None
        return self._candidates(
            self.sets.settled(self.sets.known, first_poses(graph, self.sets.known))
        )

    def _in_place_of_misfits(self, fit: Fit, cluster: IntArray) -> Fit:
        """The fit with a cluster, and then with the edges within their thresholds alone."""
        return self._within_thresholds(self.sets.settled(with_edges(fit.kept, cluster), fit.poses))

    def _within_thresholds(self, fit: Fit) -> Fit:
        """The fit with the edges within their thresholds alone, as the map follows them."""
        for _ in range(_MOST_ROUNDS):
            kept = self.sets.within(fit.poses)
            if np.array_equal(kept, fit.kept):
                return fit
            fit = self.sets.settled(kept, fit.poses)
        return fit

    @property
    def _most_failures(self) -> int:
        """Clusters that are tried in a row without success, or for an exchange, at most."""
        return max(1, min(_MOST_FAILURES, _MOST_WORK // self.sets.problem.num_poses))


def wrong_ones_within(number: float, deviation: float, p: int) -> float:
    """Most wrong edges to expect within their thresholds, of so many within four times these.

    `deviation` is the standard deviation of their number, p how many numbers a motion has; see
    `ClusterSearch.expected_by_chance`.
    """
    return (number + 2.0 * deviation) / float(_FAR ** (0.5 * p) - 1.0)
