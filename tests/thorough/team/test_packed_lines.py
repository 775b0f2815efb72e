"""Lines of measurements come out of their bytes as they went in, and are few bytes."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from budget import examples

import pgo_models as pgo
from solvers.carry.wire import WireError
from solvers.team.measurements import Revision
from solvers.team.news import News, Piece
from solvers.team.packed_lines import PackedLines, packed_lines, unpacked_lines

MOST = 1 << 20
WORDS = [
    *("EDGE_SE2", "FIX", "#", "", "\0", "\0\0", "\1", "\0011", "\2", "\2\0", "-0.0", "1e-300"),
    *("0", "00", "7", "-3", "9223372036854775807", "99999999999999999999", "\u0663", "\u2002x"),
    *("0.1", "0.30000000000000004", "123456789012", "1234567890.12345", "1_000_000_000.5"),
    *("nan", "infinity_and_beyond", "6.02214076e+23", "4294967295.9999995", "4294967296.000001"),
    *("2.3283064365386963e-10", "-2.328306436538696e-10", "0.123456789012\r", "\u00e9" * 12),
]


@pytest.mark.parametrize("seed", range(examples(40)))
def test_any_lines_come_out_as_they_went_in(seed: int) -> None:
    rng = np.random.default_rng(seed)
    drawn = [repr(x) for x in rng.normal(size=20) * 2.0 ** rng.integers(-40, 40, 20)]
    text = ""
    for _ in range(100):
        text += " ".join(rng.choice(WORDS + drawn, rng.integers(1, 9))) + rng.choice(["\n", "\r\n"])
    lines = text.splitlines(keepends=True)
    cut = int(rng.integers(0, len(lines)))
    packed = packed_lines(lines[cut:], lines[:cut])
    assert unpacked_lines(packed, lines[:cut], MOST) == lines[cut:]


def test_an_edge_takes_the_mantissas_of_six_numbers_and_little_else(tmp_path: object) -> None:
    graph = pgo.grid_world(1, 200, 3)
    pgo.write_g2o(graph, f"{tmp_path}/graph.g2o")
    with open(f"{tmp_path}/graph.g2o", encoding="utf-8") as file:
        lines = [line for line in file if line.startswith("EDGE")]
    odometry = lines[:150]
    packed = packed_lines(odometry[100:], odometry[:100])
    assert len(packed.numbers) <= 50 * 6 * 52 / 8 + 50 * 5
    assert packed.forms == b""
    assert unpacked_lines(packed, odometry[:100], MOST) == odometry[100:]


@pytest.mark.parametrize("seed", range(examples(20)))
def test_bytes_that_are_no_lines_are_refused(seed: int) -> None:
    rng = np.random.default_rng(seed)
    right = packed_lines(["EDGE_SE2 1 2 0.1234567890123 0.5 0.25\n"] * 30, [])
    noise = bytes(rng.integers(0, 256, 40, dtype=np.uint8))
    wrong = [
        right._replace(numbers=noise),
        right._replace(numbers=right.numbers[:-1]),
        right._replace(numbers=right.numbers[1:]),
        right._replace(numbers=right.numbers + b"0"),
        right._replace(numbers=b""),
        right._replace(numbers=bytes(MOST + 1)),
        right._replace(forms=noise),
        right._replace(forms=right.forms[:-1]),
        right._replace(num_lines=29),
        right._replace(num_lines=1 << 20),
    ]
    for packed in wrong:
        with pytest.raises(WireError):
            unpacked_lines(packed, [], MOST)
    with pytest.raises(WireError):
        unpacked_lines(right, [], 100)


def test_lines_that_would_take_long_to_be_read_come_one_part_after_the_other() -> None:
    rng = np.random.default_rng(0)
    ids = rng.integers(1 << 60, size=(1000, 2)).tolist()
    lines = [f"EDGE {i} {j}\n" for i, j in ids]
    received: list[str] = []
    while len(received) < len(lines):
        packed = packed_lines(lines[len(received) :], received)
        assert 0 < packed.num_lines < 500
        received += unpacked_lines(packed, received, MOST)
    assert received == lines
    numbers = " ".join(map(repr, rng.normal(size=9000).tolist()))
    with pytest.raises(WireError, match="too many symbols"):
        unpacked_lines(packed_lines([f"EDGE 1 2 {numbers}\n"], []), [], MOST)


@pytest.mark.parametrize(("num_letters", "is_known"), [(500, True), (1000, False)])
def test_long_lines_before_are_forgotten_sooner(num_letters: int, is_known: bool) -> None:
    line = "EDGE 1 2 once\n"
    before = [line, *(f"# {'x' * num_letters}\n" for _ in range(40))]
    packed = packed_lines([line], before)
    assert (packed.forms == b"") == is_known
    assert unpacked_lines(packed, before, MOST) == [line]


@pytest.mark.parametrize("seed", range(examples(20)))
def test_messages_come_out_of_their_bytes_and_changed_bytes_are_messages_or_refused(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    before = Revision(200, "0123456789abcdef")
    has = {"anna": before, "\u00e9": Revision(1 << 40, "00ff")}
    pieces = (
        Piece("ben", Revision(), PackedLines(2, b"", b"\x00numbers"), True),
        Piece("anna", before, PackedLines(0, b"f", b""), False),
    )
    news = News(has, ("ben", "dora"), pieces, True, ("anna",), 12345678, 0, is_prompt=True)
    own = Piece("ben", Revision(9), PackedLines(2, b"", b"numbers"), True)
    short = News({}, (), (own,), sent=300, answers=7, has_all=True, is_short=True)
    without = News({"anna": before}, (), answers=128, is_prompt=True, is_short=True)
    for message in (news, short, without):
        data = message.as_bytes()
        read = News.from_bytes(data, "ben", "anna")
        assert vars(read) | {"pieces": ()} == vars(message) | {"pieces": ()}
        assert [*map(vars, read.pieces)] == [*map(vars, message.pieces)]
        for _ in range(100):
            changed = bytearray(data)
            changed[rng.integers(len(data))] = rng.integers(256)
            with suppress(WireError):
                News.from_bytes(bytes(changed[: rng.integers(len(data) + 1)]), "ben", "anna")
