"""Maximum cliques: a greedy set, then branch and bound with greedy colouring on bitsets (San Segundo et al. 2011)."""

from __future__ import annotations

import numpy as np

from pgo_models.geometry.rotations import BoolArray

_MOST_COLOURINGS = 1_000_000  # of a vertex: a few seconds, and no clock, so that the same graph gives the same set


def maximum_clique(adjacent: BoolArray, most_colourings: int = _MOST_COLOURINGS) -> tuple[BoolArray, bool]:
    """A largest set, (n,), of vertices that are all adjacent, and whether it is proven to be one.

    Greedy: take out the vertex with the fewest neighbours left until all are adjacent. Vertices of too few neighbours
    for a larger clique go, those adjacent to all others are in it; on the rest a greedy colouring bounds what every
    branch can hold. `adjacent`, (n, n), is symmetric without a diagonal. Own code: networkx, in pure Python and no
    dependency, takes the same exponential time without bitsets.
    """
    found = _greedy(adjacent)
    alive = np.ones(len(adjacent), dtype=bool)
    while not (enough := adjacent[:, alive].sum(axis=1) >= found.sum())[alive].all():
        alive &= enough
    in_all = alive & (adjacent[:, alive].sum(axis=1) == alive.sum() - 1)
    rest = np.flatnonzero(alive & ~in_all)
    rest = rest[np.argsort(-adjacent[rest][:, rest].sum(axis=1), kind="stable")]
    rows = np.packbits(adjacent[rest][:, rest], axis=1, bitorder="little")
    neighbours = [int.from_bytes(row.tobytes(), "little") for row in rows]
    larger, is_proven = _branch(neighbours, int(found.sum() - in_all.sum()), most_colourings)
    if larger:
        found = in_all.copy()
        found[rest[larger]] = True
    return found, is_proven


def _greedy(adjacent: BoolArray) -> BoolArray:
    kept, degree = np.ones(len(adjacent), dtype=bool), adjacent.sum(axis=1)
    for count in range(len(adjacent), 0, -1):
        worst = int(np.argmin(np.where(kept, degree, len(adjacent))))
        if degree[worst] == count - 1:
            break
        kept[worst] = False
        degree = degree - adjacent[worst]
    while (more := adjacent[:, kept].all(axis=1) & ~kept).any():
        kept[np.argmax(more)] = True
    return kept


def _branch(neighbours: list[int], best: int, most_colourings: int) -> tuple[list[int], bool]:
    """A clique of more than `best` vertices, the largest, else none; and whether the search came to its end."""
    found: list[int] = []
    chosen: list[int] = []
    everyone = (1 << len(neighbours)) - 1
    levels = [(_coloured(neighbours, everyone), everyone)]
    work = len(neighbours)
    while levels:
        branches, candidates = levels.pop()
        if not branches or len(chosen) + branches[-1][1] <= best:
            if chosen:
                chosen.pop()
            continue
        vertex, _ = branches.pop()
        levels.append((branches, candidates & ~(1 << vertex)))
        chosen.append(vertex)
        if inner := candidates & neighbours[vertex]:
            work += inner.bit_count()
            if work > most_colourings:
                return found, False
            levels.append((_coloured(neighbours, inner), inner))
            continue
        if len(chosen) > best:
            best, found = len(chosen), list(chosen)
        chosen.pop()
    return found, True


def _coloured(neighbours: list[int], candidates: int) -> list[tuple[int, int]]:
    """(vertex, colour), ascending from 1; adjacent vertices differ, so that a clique has one of each colour at most."""
    order, colour = [], 0
    while candidates:
        colour += 1
        apart = candidates
        while apart:
            lowest = apart & -apart
            vertex = lowest.bit_length() - 1
            order.append((vertex, colour))
            candidates ^= lowest
            apart &= ~(neighbours[vertex] | lowest)
    return order
