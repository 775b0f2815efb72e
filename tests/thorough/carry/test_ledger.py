"""The ledger and its counts; the channel and its losses, delays and silences."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from pgo_models.errors import SettingError
from solvers import Faults
from solvers.carry.faults import LossyChannel
from solvers.carry.ledger import DRIVER, Ledger, Traffic

Link = tuple[int, int]
LINKS = [(a, b) for a in range(4) for b in range(4) if a != b]


def traffic(*messages: tuple[int, int, int]) -> Traffic:
    sender, receiver, num_bytes = np.array(messages).T
    return Traffic(sender, receiver, num_bytes)


def test_totals_are_sums_over_links_and_rounds() -> None:
    to_driver = traffic((0, DRIVER, 10), (1, DRIVER, 20), (2, DRIVER, 30))
    back = traffic((DRIVER, 0, 1), (DRIVER, 1, 2), (DRIVER, 2, 3))
    ledger = (
        Ledger(3)
        .after_round(to_driver, back)
        .after_round(to_driver, back)
        .after_round(traffic((0, 1, 7)))
    )
    assert (ledger.rounds, ledger.messages, ledger.num_bytes) == (3, 13, 2 * 66 + 7)
    np.testing.assert_array_equal(ledger.bytes_sent, [27, 40, 60])
    np.testing.assert_array_equal(ledger.bytes_received, [2, 4 + 7, 6])
    sender, receiver, messages, num_bytes = ledger.by_link()
    counts = {
        (s, r): (q, b) for s, r, q, b in zip(sender, receiver, messages, num_bytes, strict=True)
    }
    assert counts[DRIVER, 1] == (2, 4)
    assert counts[0, 1] == (1, 7)
    assert len(counts) == 7


def test_snapshots_are_counted_apart() -> None:
    ledger = Ledger(2).after_round(Traffic(*np.array([[0], [1], [80]])))
    after = ledger.after_snapshots(1000).after_snapshots(234)
    assert after.snapshot_bytes == 1234
    assert (after.num_bytes, after.messages, after.rounds) == (
        ledger.num_bytes,
        ledger.messages,
        ledger.rounds,
    )
    assert after.joined(after).snapshot_bytes == 2468
    assert (
        "snapshots",
        "1,234 bytes to the driver's process, interior poses among them",
    ) in after.facts()
    assert "snapshots" not in dict(ledger.facts())


def test_bytes_are_compared_with_a_list_of_all_edges() -> None:
    ledger = Ledger(2, graph_bytes=40).after_round(Traffic(*np.array([[0], [1], [80]])))
    assert dict(ledger.facts())["bytes"].startswith("80, 2 times all edges; of one robot")
    assert ledger.joined(ledger).graph_bytes == 40
    assert "edges" not in dict(Ledger(2).facts())["bytes"]


# Faults.


def carried(faults: Faults, rounds: int) -> list[dict[Link, int]]:
    """What arrives in every round when each robot writes the number of the round to all others."""
    channel: LossyChannel[int] = LossyChannel(faults)
    return [channel.carry(dict.fromkeys(LINKS, number)) for number in range(rounds)]


SEEDS = st.integers(0, 2**32 - 1)


@given(loss=st.sampled_from([0.0, 0.2, 0.7]), seed=SEEDS)
def test_the_share_of_messages_that_are_lost(loss: float, seed: int) -> None:
    rounds = 100
    arrived = carried(Faults(loss=loss, seed=seed), rounds)
    assert all(
        message == number
        for number, messages in enumerate(arrived)
        for message in messages.values()
    )
    count = sum(len(messages) for messages in arrived)
    sent = rounds * len(LINKS)
    allowed = 6 * np.sqrt(sent * loss * (1 - loss))  # standard deviations of a binomial
    assert abs(count - (1 - loss) * sent) <= allowed


@given(max_delay=st.integers(0, 6), loss=st.sampled_from([0.0, 0.3]), seed=SEEDS)
def test_delays_are_within_bounds_and_nothing_older_follows(
    max_delay: int, loss: float, seed: int
) -> None:
    newest: dict[Link, int] = {}
    delays = []
    for number, messages in enumerate(
        carried(Faults(loss=loss, max_delay=max_delay, seed=seed), 80)
    ):
        for link, message in messages.items():
            assert 0 <= number - message <= max_delay
            assert message > newest.get(link, -1)
            newest[link] = message
            delays.append(number - message)
    assert set(delays) <= set(range(max_delay + 1))
    assert min(delays) == 0
    assert max_delay == 0 or max(delays) >= 1
    # The newest of many overlapping letters wins: an old one is used only where no newer came
    # earlier.
    if loss == 0.0:
        assert set(newest) == set(LINKS)
        assert min(newest.values()) >= 79 - max_delay


@given(seed=SEEDS, since=st.integers(0, 10), rounds=st.integers(0, 10), max_delay=st.integers(0, 3))
def test_silence_cuts_both_ways(seed: int, since: int, rounds: int, max_delay: int) -> None:
    faults = Faults(
        silent_robot=2, silent_from=since, silent_rounds=rounds, max_delay=max_delay, seed=seed
    )
    for number, messages in enumerate(carried(faults, 30)):
        is_silent = since <= number < since + rounds
        assert [faults.is_silent(robot, number) for robot in range(4)] == [
            False,
            False,
            is_silent,
            False,
        ]
        for (sender, receiver), message in messages.items():
            assert not (is_silent and receiver == 2)
            if sender == 2 or receiver == 2:  # what was sent in the silence never arrives
                assert not since <= message < since + rounds
        if max_delay == 0:
            expected = [link for link in LINKS if not (is_silent and 2 in link)]
            assert sorted(messages) == expected


@given(seed=SEEDS)
def test_the_same_seed_has_the_same_faults(seed: int) -> None:
    faults = Faults(loss=0.3, max_delay=4, seed=seed)
    assert carried(faults, 20) == carried(faults, 20)
    assert carried(faults, 20) != carried(Faults(loss=0.3, max_delay=4, seed=seed + 1), 20)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"loss": 1.0}, r"loss must be in \[0, 1\), got 1\.0"),
        ({"loss": -0.1}, r"loss must be in \[0, 1\)"),
        ({"loss": np.nan}, r"loss must be in \[0, 1\)"),
        ({"max_delay": -1}, "max_delay must not be negative, got -1"),
        ({"silent_robot": -1}, "silent_robot must not be negative"),
        ({"silent_from": -1}, "silent_from must not be negative"),
        ({"silent_rounds": -1}, "silent_rounds must not be negative"),
    ],
)
def test_faults_are_checked(changes: dict[str, float], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        Faults(**changes)
