import time

import numpy as np
import pytest
from graphs import varied_graph

import solvers
from pgo_models.errors import SettingError
from solvers import InProcess


@pytest.mark.parametrize("seed", range(3))
def test_threads_give_the_same_numbers(seed):
    graph = varied_graph(seed, 40, 2 + seed % 2)
    in_order, in_threads = (
        solvers.solve(graph, robots=solvers.Robots(4, engine=InProcess(threads)))
        for threads in (1, 3)
    )
    np.testing.assert_array_equal(in_order.poses.R, in_threads.poses.R)
    np.testing.assert_array_equal(in_order.poses.t, in_threads.poses.t)
    assert repr(in_order.ledger) == repr(in_threads.ledger)
    assert in_order.lower_bound == in_threads.lower_bound


class Slow:
    """A worker that fails at once, or obeys later."""

    def __init__(self, fails: bool) -> None:
        self.fails = fails
        self.done = []


def obey_slowly(worker, word):
    if worker.fails:
        raise SettingError("no")
    time.sleep(0.1)
    worker.done.append(word)
    return list(worker.done)


@pytest.mark.parametrize("threads", [1, 2])
def test_an_order_that_one_refuses_is_obeyed_by_the_others_before_the_next(threads):
    pool = InProcess(threads).open(Slow, [True, False])
    for word in ("first", "second"):
        with pytest.raises(SettingError, match="no"):
            pool.ask(obey_slowly, [word] * 2)
    assert pool.ask(lambda worker, _: worker.done, [None] * 2) == [[], ["first", "second"]]
    pool.close()


class Refusing:
    """An engine, and its pool, that is interrupted before anything is done."""

    is_closed = False

    def open(self, make, shares):
        return self

    def ask(self, order, requests):
        raise KeyboardInterrupt

    def close(self):
        self.is_closed = True


def test_a_solve_that_is_broken_off_while_robots_are_set_up_lets_them_go():
    engine = Refusing()
    with pytest.raises(KeyboardInterrupt):
        solvers.solve(varied_graph(1, 20, 2), robots=solvers.Robots(3, engine=engine))
    assert engine.is_closed


def test_there_is_a_thread_at_least():
    with pytest.raises(SettingError, match="threads must be at least 1, got 0"):
        InProcess(0)
