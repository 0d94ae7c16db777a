"""A reference out of a CSV file, in any unit, and what is said about a wrong one."""

from pathlib import Path

import numpy as np
import pytest

from trms_cli.core.errors import RecordingError
from trms_cli.references.from_csv import FromCsv, read_columns

GOOD = "# rig: mine\n\nt[s],r_v[rad],note_free[V]\n10,0.1,1\n11,0.3,1\n13,-0.1,1\n"


def write(folder: Path, text: str) -> str:
    path = folder / "reference.csv"
    path.write_text(text)
    return str(path)


def test_values_hold_or_are_joined_by_lines(tmp_path):
    file = write(tmp_path, GOOD)
    times = np.array([-1.0, 0.0, 0.5, 1.0, 2.0, 3.0, 99.0])
    held = FromCsv(file=file, column="r_v").sample(times)
    np.testing.assert_allclose(held, [0.1, 0.1, 0.1, 0.3, 0.3, -0.1, -0.1])
    joined = FromCsv(file=file, column="r_v", interpolation="linear").sample(times)
    np.testing.assert_allclose(joined, [0.1, 0.1, 0.2, 0.3, 0.1, -0.1, -0.1])


def test_it_is_moved_and_scaled_and_its_units_are_converted(tmp_path):
    signal = FromCsv(file=write(tmp_path, GOOD), column="r_v", start=5.0, scale=2.0, offset=1.0)
    np.testing.assert_allclose(signal.sample(np.array([5.0, 6.0])), [1.2, 1.6])
    file = write(tmp_path, "t[ms],r_h[deg]\n0,0\n500,90\n")
    signal = FromCsv(file=file, column="r_h")
    np.testing.assert_allclose(signal.sample(np.array([0.49, 0.5])), [0.0, np.pi / 2])


def test_a_recording_made_by_a_spreadsheet_is_read(tmp_path):
    path = tmp_path / "sheet.csv"
    path.write_bytes("\ufefft[s],r_v[rad]\r\n0,0.1\r\n1,0.2\r\n".encode())
    signal = FromCsv(file=str(path), column="r_v")
    np.testing.assert_allclose(signal.sample(np.array([1.0])), [0.2])


@pytest.mark.parametrize(
    ("text", "problem", "line"),
    [
        ("", "empty", ""),
        ("# only: words\n", "empty", ""),
        ("t[s],r_v[rad]\n", "no rows", ""),
        ("t[s],r_h[rad]\n0,1\n", "no column 'r_v'", ":1"),
        ("r_v[rad]\n0\n", "no column 't'", ":1"),
        ("t,r_v\n0,1\n", "has no unit", ":1"),
        ("t[s],r_v[rad],r_v[deg]\n0,1,2\n", "twice", ":1"),
        ("t[s],r_v[furlong]\n0,1\n", "furlong", ":1"),
        ("t[s],r_v[rad]\n0,1\n1\n", "1 cells under a header of 2", ":3"),
        ("t[s],r_v[rad]\n0,1\n1,\n", "not a finite number", ":3"),
        ("t[s],r_v[rad]\n0,1\n1,inf\n", "not a finite number", ":3"),
        ("t[s],r_v[rad]\n0,1\n1,one\n", "'one'", ":3"),
        ("t[s],r_v[rad]\n0,1\n\n# note\n0,2\n", "time does not rise", ":5"),
    ],
)
def test_a_wrong_file_is_told_by_its_line(tmp_path, text, problem, line):
    file = write(tmp_path, text)
    with pytest.raises(RecordingError, match=problem) as caught:
        FromCsv(file=file, column="r_v")
    assert caught.value.where == file + line
    assert caught.value.remedy


def test_a_missing_file_is_told_with_the_unit_of_what_is_read(tmp_path):
    with pytest.raises(RecordingError, match="there is no file"):
        FromCsv(file=str(tmp_path / "none.csv"), column="r_v")
    with pytest.raises(RecordingError, match="cannot be read"):
        FromCsv(file=str(tmp_path), column="r_v")
    for column, unit in (("u_v", "V"), ("r_v", "rad")):
        with pytest.raises(RecordingError) as caught:
            read_columns(tmp_path / "none.csv", column)
        assert f"t[s],{column}[{unit}]" in caught.value.remedy
