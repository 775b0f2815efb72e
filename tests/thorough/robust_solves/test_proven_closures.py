"""What bounds on closures and pairs are taken to prove, against all sets of closures."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from pgo_models.graphs.pose_graph import IntArray
from solvers.robust_solves.proven_closures import ProvenClosures


class Costs:
    """Costs of sets of closures that grow with the set, and the least truncated one."""

    def __init__(self, seed: int, k: int) -> None:
        rng = np.random.default_rng(seed)
        self.thresholds = rng.uniform(1.0, 10.0, k)
        inliers = 0.5 * rng.exponential()
        alone = rng.exponential(1.5, k) * rng.integers(0, 3, k)
        together = np.triu(rng.exponential(5.0, (k, k)) * rng.integers(0, 3, (k, k)), 1)
        self.singles = inliers + alone
        self.pairs = inliers + alone[:, None] + alone + together + together.T
        self.sets = [list(kept) for size in range(k + 1) for kept in combinations(range(k), size)]
        self.truncated = [
            inliers
            + alone[kept].sum()
            + together[np.ix_(kept, kept)].sum()
            + np.delete(self.thresholds, kept).sum()
            for kept in self.sets
        ]

    def proven(self, seed: int) -> ProvenClosures:
        """What is proven with the best answer or another one, if most bounds of pairs are found.

        Half of them are known at once, and a third is sought where classes may be joined.
        """
        answer = np.argsort(self.truncated)[min(seed % 3, len(self.sets) - 1)]
        k = len(self.thresholds)
        kept = np.zeros(k, dtype=bool)
        kept[self.sets[answer]] = True
        known = np.zeros(k, dtype=bool)
        cost = self.truncated[answer]
        proven = ProvenClosures.of(known, kept, self.thresholds, cost, self.singles.copy())
        proven.leave_out_wrong()
        left = proven.edges
        proven.pairs = np.zeros((len(left), len(left)))
        kind = np.random.default_rng(seed).integers(0, 6, (k, k))
        for a, b in combinations(range(len(left)), 2):
            if kind[left[a], left[b]] < 3:
                proven.raise_pair(a, b, self.pairs[left[a], left[b]])
        proven.use_bounds()

        def prove(e: int, members: IntArray) -> None:
            for f in members.tolist():
                a, b = sorted(proven.edges[[e, f]])
                if kind[a, b] < 5:
                    proven.raise_pair(e, f, self.pairs[a, b])

        k = len(proven.edges)
        proven.join_classes(np.ones((k, k), dtype=bool), prove)
        proven.use_bounds()
        return proven


@pytest.mark.parametrize("k", [3, 5, 7])
def test_no_set_of_closures_contradicts_what_is_proven(k: int) -> None:
    num_wrong = 0
    num_joined = 0
    for seed in range(60):
        costs = Costs(seed, k)
        proven = costs.proven(seed)
        proof = proven.proof(is_complete=True)
        num_wrong += int(proof.proven_wrong.sum())
        num_joined += len(proven.edges) - proof.most_closures
        assert proof.truncated_cost_bound <= min(costs.truncated)
        for kept, truncated in zip(costs.sets, costs.truncated, strict=True):
            if truncated <= proof.truncated_cost:
                assert not proof.proven_wrong[kept].any()
                assert len(kept) <= proof.most_closures
    assert num_wrong > 10
    assert num_joined > 10
