"""Disjoint groups of edges, with sums over each of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray


@dataclass(frozen=True, eq=False)
class EdgeGroups:
    """Groups of edges, none of which is empty."""

    edges: IntArray  # (k,): group by group
    sizes: IntArray  # (g,): how many edges each group has
    names: IntArray  # (g,): a number for every group, which it keeps when edges are taken out

    @classmethod
    def of(cls, groups: Sequence[IntArray]) -> EdgeGroups:
        """Groups of edges, named by their places."""
        edges = np.concatenate([np.zeros(0, dtype=int), *groups])
        return cls(edges, np.array([len(group) for group in groups]), np.arange(len(groups)))

    @classmethod
    def singles(cls, edges: IntArray) -> EdgeGroups:
        """Every edge as a group of its own."""
        return cls(edges, np.ones(len(edges), dtype=int), np.arange(len(edges)))

    def __len__(self) -> int:
        return len(self.sizes)

    def __getitem__(self, g: int) -> IntArray:
        first = self.beginnings[g]
        return self.edges[first : first + self.sizes[g]]

    def __iter__(self) -> Iterator[IntArray]:
        return (self[g] for g in range(len(self)))

    @cached_property
    def beginnings(self) -> IntArray:
        """Place of the first edge of every group, (g,)."""
        return np.asarray(np.cumsum(self.sizes) - self.sizes)

    @cached_property
    def group_of(self) -> IntArray:
        """Group of each of `edges`, (k,)."""
        return np.repeat(np.arange(len(self)), self.sizes)

    def sums(self, values: Array) -> Array:
        """Sums over the edges of every group, (g, ..), of numbers that all edges have, (m, ..)."""
        if len(self) == 0:
            return np.zeros((0, *values.shape[1:]))
        return np.asarray(np.add.reduceat(values[self.edges], self.beginnings, axis=0))

    def have_any(self, chosen: BoolArray) -> BoolArray:
        """Whether groups have any of the chosen edges, (m,)."""
        return self.sums(chosen.astype(float)) > 0.0

    def of_edges(self, chosen: BoolArray) -> EdgeGroups:
        """Groups without the edges that are not chosen, (m,), where some are left."""
        stays = chosen[self.edges]
        sizes = np.bincount(self.group_of[stays], minlength=len(self))
        has_edges = sizes > 0
        return EdgeGroups(self.edges[stays], sizes[has_edges], self.names[has_edges])
