import os
from pathlib import Path

import numpy as np
import pytest

from pgo_models import PGOError
from pgo_models.errors import FileFormatError
from pgo_models.files import (
    LONGEST_OF_ALL,
    finite_number,
    read_blocks,
    read_table,
    read_text,
    replace_when_done,
)
from pgo_models.graphs.trajectories import read_times


def test_text_is_read_without_the_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"\xef\xbb\xbfone\n")
    assert read_text(tmp_path / "a") == "one\n"


@pytest.mark.parametrize("data", [b"one\ntwo\0three\n", b"one\n\xff\xfe\n", b"one\n\xff\0\n"])
def test_binary_files_are_refused_at_their_line(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a").write_bytes(data)
    with pytest.raises(FileFormatError, match=r"a:2: bytes that are no text"):
        read_text(tmp_path / "a")


def test_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="nothing: no such file"):
        read_text(tmp_path / "nothing")
    with pytest.raises(FileFormatError, match="cannot be read: Is a directory"):
        read_text(tmp_path)


@pytest.mark.parametrize(
    "word", ["one", "1_000", "\u0661", "1,5", "0x10", "nan", "inf", "-Infinity", "1e999", "-1e101"]
)
def test_other_words_are_refused_with_file_line_and_value(word: str) -> None:
    with pytest.raises(FileFormatError) as caught:
        finite_number("f", 7, word)
    assert str(caught.value).startswith("f:7: ")
    assert word in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2\n3\n", "a:2: 1 numbers where 2 belong"),
        ("1 2 3\n", "a:1: 3 numbers"),
        ("#\n", "a: no rows"),
    ],
)
def test_bad_tables_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a").write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_table(tmp_path / "a", 2)


def test_replaces_only_when_done(tmp_path: Path) -> None:
    target = tmp_path / "a"
    target.write_text("old")
    with replace_when_done(target) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
        assert temporary.parent == tmp_path
    assert target.read_text() == "new"
    assert os.listdir(tmp_path) == ["a"]


def test_error_in_the_block_leaves_the_old_file_alone(tmp_path: Path) -> None:
    target = tmp_path / "a"
    target.write_text("old")

    def fail() -> None:
        with replace_when_done(target) as temporary:
            temporary.write_text("half")
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        fail()
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["a"]


def write_one(target: Path) -> None:
    with replace_when_done(target) as temporary:
        temporary.write_text("1")


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(PGOError, match=r"cannot write .*missing/a: No such file"):
        write_one(tmp_path / "missing" / "a")
    with pytest.raises(PGOError, match="not a regular file"):
        write_one(tmp_path)


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "a")
    write_one(tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "a").read_text() == "1"


def test_a_file_keeps_its_mode_and_a_new_one_has_the_usual(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    for mode in (0o600, 0o664, 0o755, 0o444):
        (tmp_path / "a").touch()
        (tmp_path / "a").chmod(mode)
        write_one(tmp_path / "a")
        assert (tmp_path / "a").stat().st_mode & 0o7777 == mode
    write_one(tmp_path / "new")
    assert (tmp_path / "new").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_link_to_nothing_makes_its_file_and_a_circle_of_links_is_refused(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "a")
    (tmp_path / "circle").symlink_to(tmp_path / "other")
    (tmp_path / "other").symlink_to(tmp_path / "circle")
    write_one(tmp_path / "link")
    assert (tmp_path / "a").read_text() == "1"
    with pytest.raises(PGOError, match=r"cannot write .*circle: "):
        write_one(tmp_path / "circle")


def test_all_wrong_rows_of_a_table_are_named(tmp_path: Path) -> None:
    rows = ["1 2"] * 30
    rows[3] = "1"
    rows[4] = "1 two"
    rows[29] = "1 2 3"
    (tmp_path / "a").write_text("\n".join(rows))
    with pytest.raises(FileFormatError) as caught:
        read_table(tmp_path / "a", 2)
    place = tmp_path / "a"
    first, second, third, last = str(caught.value).split("\n")
    assert first.startswith(f"{place}:4: 1 numbers where 2 belong")
    assert second.startswith(f"{place}:5: 'two' is no number")
    assert third.startswith(f"{place}:30: 3 numbers where 2 belong")
    assert last == "3 lines are wrong"


@pytest.mark.parametrize("end", [b"\n", b"\r", b"\r\n"], ids=["lf", "cr", "crlf"])
def test_lines_are_whole_wherever_blocks_end_and_errors_count_them(end, tmp_path):
    lines = [f"line {k} \u00e9".encode() for k in range(200)]
    path = tmp_path / "x"
    path.write_bytes(end.join(lines) + end)
    whole = "".join(line.decode() + "\n" for line in lines)
    for size in (*range(1, 40), 1000):
        blocks = list(read_blocks(path, size))
        assert "".join(blocks) == read_text(path, size) == whole
        assert all(block.endswith("\n") for block in blocks)
    for wrong in (b"\xff", b"\0", b"x" * (LONGEST_OF_ALL + 1)):
        path.write_bytes(end.join([*lines[:120], wrong, *lines]))
        for size in (13, 1000, 2**24):
            with pytest.raises(FileFormatError, match=r"x:121: "):
                read_text(path, size)
    path.write_bytes(end.join([b"#" * LONGEST_OF_ALL, b"1", b"2"]))
    np.testing.assert_array_equal(read_times(path), [1.0, 2.0])
