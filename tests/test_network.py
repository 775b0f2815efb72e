"""The ledger: what it counts."""

import numpy as np
import pytest

from pgo_models.errors import SettingError
from solvers.network import DRIVER, Ledger, Traffic


def traffic(*messages: tuple[int, int, int]) -> Traffic:
    sender, receiver, num_bytes = np.array(messages).T
    return Traffic(sender, receiver, num_bytes)


def test_totals_are_sums_over_links_and_rounds() -> None:
    to_driver = traffic((0, DRIVER, 10), (1, DRIVER, 20), (2, DRIVER, 30))
    back = traffic((DRIVER, 0, 1), (DRIVER, 1, 2), (DRIVER, 2, 3))
    ledger = Ledger(3).after_round(to_driver, back).after_round(to_driver, back).after_round(traffic((0, 1, 7)))
    assert (ledger.rounds, ledger.messages, ledger.num_bytes) == (3, 13, 2 * 66 + 7)
    np.testing.assert_array_equal(ledger.bytes_sent, [27, 40, 60])
    np.testing.assert_array_equal(ledger.bytes_received, [2, 4 + 7, 6])
    sender, receiver, messages, num_bytes = ledger.by_link()
    found = {(s, r): (q, b) for s, r, q, b in zip(sender, receiver, messages, num_bytes, strict=True)}
    assert found[DRIVER, 1] == (2, 4)
    assert found[0, 1] == (1, 7)
    assert len(found) == 7


def test_counting_leaves_the_earlier_ledger_alone_and_equal_exchanges_take_no_memory() -> None:
    before = Ledger(2)
    exchange = traffic((0, 1, 8), (1, 0, 8))
    after = before
    for _ in range(1000):
        after = after.after_round(exchange)
    assert (before.rounds, before.messages, before.num_bytes) == (0, 0, 0)
    assert (after.rounds, after.messages, after.num_bytes) == (1000, 2000, 16000)
    assert len(after.counted) == 1


def test_all_reduces_are_counted_apart() -> None:
    ledger = Ledger(4).after_all_reduce(5)
    assert (ledger.rounds, ledger.messages, ledger.all_reduces) == (0, 0, 1)
    assert ledger.all_reduce_bytes == 2 * 5 * 8 * 4


def test_a_message_needs_its_sender_receiver_and_size() -> None:
    with pytest.raises(SettingError, match="one of each"):
        Traffic(np.array([0]), np.array([1, 0]), np.array([8]))
