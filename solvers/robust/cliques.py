"""Maximum cliques: a greedy one, then branch and bound with greedy colouring on bitsets.

The search follows San Segundo, Rodriguez-Losada & Jimenez, "An exact bit-parallel algorithm for the
maximum clique problem", Computers & Operations Research 2011. A set of vertices is a Python
integer, whose bit v says whether vertex v is in it.
"""

from __future__ import annotations

import numpy as np

from pgo_models.geometry.rotations import BoolArray

# Colourings of a vertex, which take a few seconds. A limit of time would give the same graph
# different cliques.
_MOST_COLOURINGS = 1_000_000


def maximum_clique(
    adjacent: BoolArray, most_colourings: int = _MOST_COLOURINGS
) -> tuple[BoolArray, bool]:
    """A largest set, (n,), of vertices that are all adjacent, and whether it is proven to be one.

    A greedy clique comes first. Vertices with too few neighbours for a larger one are left out,
    those adjacent to all others are in it. On the rest branch and bound looks for a larger one,
    where a greedy colouring bounds what every branch can hold. `adjacent`, (n, n), is symmetric
    without a diagonal. The code is our own: networkx, in pure Python and no dependency, takes the
    same exponential time without bitsets.
    """
    clique = greedy_clique(adjacent)
    candidates = _with_enough_neighbours(adjacent, int(clique.sum()))
    num_others = candidates.sum() - 1
    in_all = candidates & (adjacent[:, candidates].sum(axis=1) == num_others)
    rest = np.flatnonzero(candidates & ~in_all)
    degree = adjacent[rest][:, rest].sum(axis=1)
    rest = rest[np.argsort(-degree, kind="stable")]
    rows = np.packbits(adjacent[rest][:, rest], axis=1, bitorder="little")
    neighbours = [int.from_bytes(row.tobytes(), "little") for row in rows]
    size_to_beat = int(clique.sum() - in_all.sum())
    larger, is_proven = _branch(neighbours, size_to_beat, most_colourings)
    if larger:
        clique = in_all.copy()
        clique[rest[larger]] = True
    return clique, is_proven


def greedy_clique(adjacent: BoolArray) -> BoolArray:
    """Vertices, (n,), that are all adjacent.

    Vertices with the fewest neighbours are taken out until all are adjacent; then those adjacent to
    all that are left are added.
    """
    clique = np.ones(len(adjacent), dtype=bool)
    degree = adjacent.sum(axis=1)
    for count in range(len(adjacent), 0, -1):
        worst = int(np.argmin(np.where(clique, degree, len(adjacent))))
        if degree[worst] == count - 1:
            break
        clique[worst] = False
        degree = degree - adjacent[worst]
    while True:
        addable = adjacent[:, clique].all(axis=1) & ~clique
        if not addable.any():
            return clique
        clique[np.argmax(addable)] = True


def _with_enough_neighbours(adjacent: BoolArray, count: int) -> BoolArray:
    """Vertices, (n,), that have at least `count` neighbours among these vertices."""
    candidates = np.ones(len(adjacent), dtype=bool)
    while True:
        has_enough = adjacent[:, candidates].sum(axis=1) >= count
        if has_enough[candidates].all():
            return candidates
        candidates &= has_enough


def _branch(neighbours: list[int], best_size: int, most_colourings: int) -> tuple[list[int], bool]:
    """A largest clique of more than `best_size` vertices, else none, and whether this is proven.

    `levels` holds, for every vertex of the clique `chosen` and the next one, the vertices that may
    follow, coloured, and the set of them. A clique has at most one vertex of each colour: where the
    vertices chosen and the colours left are not more than the best size, the branch ends.
    """
    best: list[int] = []
    chosen: list[int] = []
    all_vertices = (1 << len(neighbours)) - 1
    levels = [(_coloured(neighbours, all_vertices), all_vertices)]
    num_coloured = len(neighbours)
    while levels:
        branches, candidates = levels.pop()
        if not branches or len(chosen) + branches[-1][1] <= best_size:
            if chosen:
                chosen.pop()
            continue
        vertex, _ = branches.pop()
        levels.append((branches, candidates & ~(1 << vertex)))
        chosen.append(vertex)
        inner = candidates & neighbours[vertex]
        if inner:
            num_coloured += inner.bit_count()
            if num_coloured > most_colourings:
                return best, False
            levels.append((_coloured(neighbours, inner), inner))
            continue
        if len(chosen) > best_size:
            best_size = len(chosen)
            best = list(chosen)
        chosen.pop()
    return best, True


def _coloured(neighbours: list[int], candidates: int) -> list[tuple[int, int]]:
    """Candidates as (vertex, colour), colours ascending from 1; adjacent vertices differ."""
    order = []
    colour = 0
    while candidates:
        colour += 1
        same_colour = candidates
        while same_colour:
            lowest = same_colour & -same_colour
            vertex = lowest.bit_length() - 1
            order.append((vertex, colour))
            candidates ^= lowest
            same_colour &= ~(neighbours[vertex] | lowest)
    return order
