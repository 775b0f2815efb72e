from dataclasses import replace

import numpy as np
import pytest

import pgo_models as pgo
from solvers.reporting.graph_facts import describe_graph, memory_note


def chain(n, closures, d):
    """A chain of n poses and some closures over 10 of them."""
    i = np.append(np.arange(n - 1), np.arange(closures) % (n - 10))
    j = np.append(np.arange(1, n), np.arange(closures) % (n - 10) + 10)
    ones = np.ones(len(i))
    return pgo.PoseGraph(
        n, i, j, np.tile(np.eye(d), (len(i), 1, 1)), np.ones((len(i), d)), ones, ones
    )


# Peaks of `pgo solve` on grid worlds of so many poses and edges, less those of the program, in GB.
@pytest.mark.parametrize(
    ("d", "n", "m", "measured"),
    [
        (2, 100_000, 167_400, 0.70),
        (2, 300_000, 518_997, 2.22),
        (3, 50_000, 83_018, 1.50),
        (3, 100_000, 171_327, 3.52),
    ],
)
def test_the_memory_of_a_large_graph_is_said_as_it_was_measured(d, n, m, measured):
    words = memory_note(chain(n, m - n + 1, d)).split()
    assert words[:4] == ["a", "solve", "takes", "about"]
    assert float(words[4]) == pytest.approx(measured, rel=0.2)


def test_a_long_road_with_few_closures_takes_little():
    assert memory_note(chain(400_000, 100, 2)) == ""


def test_what_would_take_much_memory_is_not_done_to_describe_a_graph():
    small, large = (describe_graph(replace(chain(n, n, 2), name="chain")) for n in (100, 100_000))
    assert [row[0] for row in small][-2:] == ["F, chordal", "Cholesky"]
    assert [row[0] for row in large][-2:] == ["memory", "Cholesky"]
