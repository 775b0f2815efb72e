from pathlib import Path

import numpy as np
import pytest
from graphs import assert_says

from pgo_models.errors import FileFormatError
from pgo_models.graphs.g2o_parser import read_lines
from pgo_models.graphs.g2o_rows import information_of, poses_of

IDENTITY_3D = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
EDGE_3D = f"EDGE_SE3:QUAT 0 1 1 2 3 0 0 0 1 {IDENTITY_3D}"
EDGE_2D = "EDGE_SE2 0 1 1 2 0.5 4 0 0 4 0 9"
VERTEX_3D = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1"


def write(folder: Path, *lines: str) -> Path:
    path = folder / "graph.g2o"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    ("lines", "where", "words"),
    [
        ([EDGE_3D, EDGE_3D[:-2]], ":2", ["30 in all", "found 29", "cut off"]),
        ([EDGE_3D, "EDGE_SE3:QUAT 0 1"], ":2", ["30 in all", "found 2", "cut off"]),
        ([EDGE_3D, "EDGE_SE3:QUAT"], ":2", ["found 0"]),
        ([EDGE_3D, EDGE_3D + " 1"], ":2", ["found 31", "too long"]),
        ([EDGE_3D[:-2]], ":1", ["found 29"]),
        ([EDGE_2D, "VERTEX_SE2 0 1 2"], ":2", ["VERTEX_SE2 needs 1 id and 3 numbers", "found 3"]),
        ([EDGE_2D, "VERTEX_SE2"], ":2", ["found 0"]),
        ([EDGE_2D, "VERTEX_SE2 0"], ":2", ["found 1"]),
        ([EDGE_3D, "", EDGE_3D.replace("2 3", "two 3")], ":3", ["'two'", "no number"]),
        ([EDGE_3D, EDGE_3D.replace("2 3", "2_0 3")], ":2", ["'2_0'"]),
        ([EDGE_3D, EDGE_3D.replace("2 3", "nan 3")], ":2", ["nan is not finite"]),
        ([EDGE_3D, EDGE_3D.replace("2 3", "-inf 3")], ":2", ["-inf is not finite"]),
        ([EDGE_3D, EDGE_3D.replace("2 3", "1e999 3")], ":2", ["1e999 is not finite"]),
        ([EDGE_3D, EDGE_3D.replace("2 3", "1e300 3")], ":2", ["1e300 is beyond 1e+100"]),
        (
            [EDGE_3D, EDGE_3D.replace("2 3", "-1e100 3")],
            ":2",
            ["1e+100 m is beyond 1e+15 m", "correct the line"],
        ),
        ([EDGE_2D, "VERTEX_SE2 0 2e15 0 0"], ":2", ["2e+15 m is beyond 1e+15 m"]),
        ([EDGE_3D, EDGE_3D + " 1" * 10_000], ":2", ["characters", "break or remove it"]),
        ([EDGE_3D, EDGE_3D[:-1] + "1e-320"], ":2", ["rotation block"]),
        ([EDGE_3D, EDGE_3D.replace(" 0 1 1 ", " 0 1.0 1 ", 1)], ":2", ["id '1.0' is no integer"]),
        ([EDGE_3D, EDGE_3D.replace(" 0 1 1 ", " 0 b1 1 ", 1)], ":2", ["id 'b1' is no integer"]),
        ([EDGE_3D, EDGE_3D.replace(" 0 1 1 ", " 0 1_1 1 ", 1)], ":2", ["id '1_1' is no integer"]),
        ([EDGE_3D, EDGE_3D.replace(" 0 1 1 ", " 0 0.5 1 ", 1)], ":2", ["id '0.5' is no integer"]),
        ([EDGE_3D, EDGE_3D[:-1] + "nan"], ":2", ["nan is not finite"]),
        ([EDGE_3D, EDGE_3D[:-1] + "1+0j"], ":2", ["'1+0j' is no number"]),
        ([EDGE_3D, "FIX 0_1"], ":2", ["id '0_1' is no integer"]),
        (
            [EDGE_3D, EDGE_3D.replace(" 0 1 1 ", f" 0 {2**64} 1 ", 1)],
            ":2",
            ["does not fit 64 bits"],
        ),
        (
            [EDGE_3D, EDGE_3D.replace("3 0 0 0 1", "3 0 0 0 0")],
            ":2",
            ["zero quaternion", "0 0 0 1"],
        ),
        ([EDGE_3D, VERTEX_3D[:-1] + "0"], ":2", ["zero quaternion"]),
        ([EDGE_3D, EDGE_3D.replace(" 0 1 ", " 1 1 ", 1)], ":2", ["from pose 1 to itself"]),
        (
            [EDGE_3D, EDGE_3D[:-1] + "-1"],
            ":2",
            ["rotation block", "indefinite", "eigenvalue -1"],
        ),
        (
            [EDGE_3D, EDGE_3D.replace("1 1 0 0 0 0 0 1", "1 -1 0 0 0 0 0 1")],
            ":2",
            ["translation block", "-1"],
        ),
        ([EDGE_2D, EDGE_2D[:-1] + "-9"], ":2", ["rotation block", "-9"]),
        ([EDGE_2D, EDGE_2D.replace("4 0 0 4", "4 5 0 4")], ":2", ["translation block"]),
        ([EDGE_3D, EDGE_3D.replace("3 0 0 0 1", "3 0 0 0 9e-10")], ":2", ["zero quaternion"]),
        ([EDGE_3D, VERTEX_3D[:-7] + "6e-10 0 6e-10 -3e-10"], ":2", ["zero quaternion"]),
        ([EDGE_2D, EDGE_2D.replace("4 0 0 4", "1 1 0 0.99")], ":2", ["translation block"]),
        ([EDGE_3D, EDGE_3D[:-5] + "1 1 0.99"], ":2", ["rotation block"]),
        ([VERTEX_3D, EDGE_3D, f"{VERTEX_3D}2"], ":3", ["second VERTEX line of pose 0", "line 1"]),
        ([EDGE_3D, EDGE_3D, EDGE_2D], ":3", ["2D and 3D", "line 1"]),
        ([EDGE_3D, "FIX first"], ":2", ["id 'first' is no integer"]),
        (
            [EDGE_3D, "EDGE_SE3_EXPMAP 0 1 2 3"],
            ":2",
            ["'EDGE_SE3_EXPMAP'", "--skip-unknown", "EDGE_SE3:QUAT", "FIX"],
        ),
        ([EDGE_3D, "garbage"], ":2", ["'garbage'"]),
        (["# nothing", ""], "", ["no measurement"]),
    ],
)
def test_every_fault_has_file_line_and_value(
    tmp_path: Path, lines: list[str], where: str, words: list[str]
) -> None:
    path = write(tmp_path, *lines)
    with pytest.raises(FileFormatError) as caught:
        read_lines(path)
    assert_says(caught.value, f"{path}{where}: ", words)


def test_everything_that_is_no_measurement_is_skipped(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        "# a comment",
        "",
        "   ",
        "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1",
        "\t" + EDGE_3D + "  \r",
        "FIX 0 1",
    )
    found = read_lines(path)
    assert found.d == 3
    np.testing.assert_array_equal(found.edge_ids, [[0, 1]])
    np.testing.assert_array_equal(found.fixed, [0, 1])
    np.testing.assert_array_equal(found.fixed_lines, [6, 6])


def test_blank_lines_count(tmp_path: Path) -> None:
    vertices = [f"VERTEX_SE2 {k} {k} 0 0" for k in range(20)]
    edges = [f"EDGE_SE2 {k} {k + 1} 1 0 0 1 0 0 1 0 1" for k in range(19)]
    lines = ["", *vertices, "", "", *edges[:10], "", *edges[10:], ""]
    found = read_lines(write(tmp_path, *lines))
    np.testing.assert_array_equal(found.vertex_lines, np.arange(2, 22))
    np.testing.assert_array_equal(found.edge_lines, [*range(24, 34), *range(35, 44)])
    with pytest.raises(FileFormatError, match=r":45: 'x' is no number"):
        read_lines(write(tmp_path, *lines, "EDGE_SE2 0 1 x 0 0 1 0 0 1 0 1"))


def test_what_is_just_no_fault_is_read(tmp_path: Path) -> None:
    # Two pivots above the level at which a block counts as singular, and a short quaternion with a
    # direction.
    almost = EDGE_2D.replace("4 0 0 4", "1 1 0 1.000000000000002")
    assert information_of(2, read_lines(write(tmp_path, almost)).edges)[0, 1, 1] > 1
    found = read_lines(
        write(tmp_path, EDGE_3D.replace("3 0 0 0 1", "3 0 0 1.1e-9 0"), VERTEX_3D[:-1] + "-1.1e-9")
    )
    np.testing.assert_allclose(
        poses_of(3, found.edges)[0][0], np.diag([-1.0, -1.0, 1.0]), rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(poses_of(3, found.vertices)[0][0], np.eye(3), rtol=0, atol=1e-15)
