"""CSV recordings: what is read, what is refused, and in which words."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.channels import CHANNELS
from trms_cli.recordings.csv_recording import read_csv, write_csv
from trms_cli.recordings.recording import Recording

GOOD = "t[s],u_v[V],alpha_v[rad]\n0,1,0.5\n0.1,2,0.6\n0.2,3,0.7\n"


@pytest.fixture
def csv(tmp_path: Path) -> Path:
    return tmp_path / "rec.csv"


def read_text(path: Path, text: str | bytes) -> Recording:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_csv(path)


def test_metadata_header_numbers(csv: Path) -> None:
    recording = read_text(csv, "# rig: bench: 2\n#loop:open\n\n" + GOOD)
    assert recording.metadata == {"rig": "bench: 2", "loop": "open"}
    np.testing.assert_array_equal(recording.time, [0, 0.1, 0.2])
    np.testing.assert_array_equal(recording.channels["u_v"], [1, 2, 3])
    assert recording.units == {"u_v": "V", "alpha_v": "rad"}
    assert recording.sample_time == 0.1 and recording.notes() == []


@pytest.mark.parametrize(
    "disguise",
    [
        lambda text: "\ufeff" + text,
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: text.replace(",", " , "),
        lambda text: text + "\n\n",
        lambda text: text.replace("t[s],u_v[V]", '"t[s]",t_[V]').replace("t_", "u_v"),
        lambda text: text.replace("0.5", '"0.5"'),
        lambda text: text.replace("[V]", " [ V ]"),
    ],
)
def test_other_programs_ways_of_writing(csv: Path, disguise: object) -> None:
    recording = read_text(csv, disguise(GOOD))
    np.testing.assert_array_equal(recording.channels["alpha_v"], [0.5, 0.6, 0.7])


@pytest.mark.parametrize(
    ("header", "name", "value", "unit"),
    [
        ("alpha_v[deg]", "alpha_v", math.pi / 180, "rad"),
        ("alpha_v[°]", "alpha_v", math.pi / 180, "rad"),
        ("alpha_v[mrad]", "alpha_v", 1e-3, "rad"),
        ("omega_v[rpm]", "omega_v", 2 * math.pi / 60, "rad/s"),
        ("omega_v[deg/s]", "omega_v", math.pi / 180, "rad/s"),
        ("u_v[mV]", "u_v", 1e-3, "V"),
        ("u_v[%]", "u_v", 1e-2, "1"),
        ("u_v[1]", "u_v", 1.0, "1"),
        ("i_v[mA]", "i_v", 1e-3, "A"),
        ("d_load[mN*m]", "d_load", 1e-3, "N*m"),
        ("d_load[1]", "d_load", 1.0, "1"),
        ("d_wind[km/h]", "d_wind", 1 / 3.6, "m/s"),
    ],
)
def test_units_become_si(csv: Path, header: str, name: str, value: float, unit: str) -> None:
    others = [cell for cell in ("u_v[V]", "alpha_v[rad]") if not cell.startswith(f"{name}[")]
    rows = "\n".join(f"{k}," + ",".join(["1"] * (len(others) + 1)) for k in range(3))
    recording = read_text(csv, f"t[ms],{','.join([*others, header])}\n{rows}\n")
    assert recording.units[name] == unit
    assert recording.sample_time == pytest.approx(1e-3)
    np.testing.assert_allclose(recording.channels[name], value, rtol=1e-12)


def test_missing_cells_gaps_jitter_and_a_last_line_without_its_end_are_told(csv: Path) -> None:
    rows = "0,1,\n0.1,,0.6\n0.2,3, \n0.3,3,1\n0.9,3,1\n1.0,3,1\n"
    recording = read_text(csv, "t[s],u_v[V],alpha_v[rad]\n" + rows)
    assert recording.missing == {"u_v": 1, "alpha_v": 2}
    assert recording.gaps == [(0.3, 0.9)]
    notes = " | ".join(recording.notes())
    assert "about 5 samples" in notes and "alpha_v: 2 of 6" in notes
    assert len(recording.time) == 6
    times = [0, 0.1, 0.2, 0.31, 0.4, 0.5]
    rows = "".join(f"{t},1,1\n" for t in times)
    (note,) = read_text(csv, "t[s],u_v[V],alpha_v[rad]\n" + rows).notes()
    assert "uneven sampling" in note and "90 to 110 ms" in note
    recording = read_text(csv, GOOD.rstrip("\n"))
    assert len(recording) == 3
    assert any("no line end" in note for note in recording.notes())


HEAD = "t[s],u_v[V],alpha_v[rad]\n"


@pytest.mark.parametrize(
    ("text", "line", "problem", "remedy"),
    [
        # header
        ("t[s],u_v[V],alfa_v[rad]\n", 1, r"'alfa_v' is not known.*'alpha_v'", "names are"),
        ("# rig: x\nt[s],u_v[V],Alpha_V[rad]\n", 2, "did you mean 'alpha_v'", "names are"),
        ("t[s],u_v,alpha_v[rad]\n", 1, "'u_v' has no unit", r"u_v\[V\]"),
        ("t,u_v[V],alpha_v[rad]\n", 1, "'t' has no unit", r"t\[s\]"),
        ("t[s],u_v[V],alpha_v[]\n", 1, "empty brackets", r"alpha_v\[rad\]"),
        ("t[s],u_v[V],alpha_v[V]\n0,1,1\n1,1,1\n", 1, "'alpha_v'.*'V' does not fit", r"\[rad\]"),
        ("t[s],u_v[rad],alpha_v[rad]\n0,1,1\n1,1,1\n", 1, "'u_v'.*does not fit", r"\[V\]"),
        ("t[s],u_v[V],omega_v[Hz]\n0,1,1\n1,1,1\n", 1, "'Hz' does not fit.*rpm", r"rad/s"),
        ("t[s],u_v[V],alpha_v[1]\n0,1,1\n1,1,1\n", 1, "'1' does not fit", "rad"),
        ("t[s],u_v[V],alpha_v[furlong]\n0,1,1\n1,1,1\n", 1, "'furlong' does not fit", "rad"),
        ("t[s],u_v[V],alpha_v[blorp]\n0,1,1\n1,1,1\n", 1, "'blorp' is not known", "rad"),
        ("t[s],u_v[V],alpha_v[x)(]\n0,1,1\n1,1,1\n", 1, r"'x\)\(' is not known", "rad"),
        ("t[s],u_v[V],u_v[V],alpha_v[rad]\n", 1, "'u_v' stands twice.*2 and 3", "keep one"),
        ("u_v[V],alpha_v[rad]\n", 1, "lacks time", "every recording"),
        ("t[s],alpha_v[rad]\n", 1, "lacks an input", "u_v, u_h"),
        ("t[s],u_v[V],r_v[rad]\n", 1, "lacks an output", "alpha_v"),
        ("t[s],u_v[V],alpha_v[rad],\n", 1, "column 4 has no name", "comma too many"),
        ("t[s];u_v[V];alpha_v[rad]\n", 1, "semicolons", "commas"),
        ("t[s]\tu_v[V]\talpha_v[rad]\n", 1, "tabs", "commas"),
        ("0,1,2\n1,2,3\n", 1, "header is missing", "write the names"),
        ("# rig: x\n", None, "no header", "write one"),
        # rows
        (HEAD, 2, "no numbers", "two samples"),
        (HEAD + "0,1,2\n", 2, "single row", "two samples"),
        (HEAD + "0,1,2\n1,1\n2,1,2\n", 3, "2 cells where the header has 3", "empty cells"),
        (HEAD + "0,1,2,3\n1,1,2\n", 2, "4 cells where the header has 3", "as many"),
        (HEAD + "0,0,1,0,2,0\n1,1,1\n", 2, "decimal commas", "0.25"),
        (HEAD + "0;1;2\n", 2, "semicolons", "0.25"),
        (HEAD + "0,1,2\n1,1,2\n# end\n", 4, "# line below", "above"),
        (HEAD + "0,1,2\n1,one,2\n", 3, "'u_v' holds 'one'", "0.25"),
        (HEAD + "0,1,2\n1,1_0,2\n", 3, "'u_v' holds '1_0'", "0.25"),
        (HEAD + "0,1,2\nNaN,1,2\n", 3, "'t' is empty", "its time"),
        (HEAD + "0,1,2\n1,-inf,2\n", 3, "'u_v' holds '-inf', which is not finite", "empty"),
        (HEAD + "0,1,2\n1,1e999,2\n", 3, "not finite", "empty"),
        (HEAD + "0,1,2\n,1,2\n", 3, "'t' is empty", "its time"),
        (HEAD + "0,1,2\n2,1,2\n1,1,2\n", 4, "runs back: 1 s after 2 s", "sort"),
        (HEAD + "0,1,2\n1,1,2\n1,1,2\n", 4, "repeats", "one per time"),
        (HEAD + "0,1,2\n1,1,2\n2,1", 4, "ends in the middle of the line: 2 of 3", "cut"),
        (HEAD + "0,1,2.25\n1,1,2.25\n2,1,2.2", 4, "middle of the last cell", "cut"),
        (HEAD + "0,1,2\n1,1,2\n2,1,", 4, "middle of the last cell", "cut"),
        (HEAD + "0,,2\n1,,2\n", 1, "no input has a single value", "needs numbers"),
        # not text
        ("", None, "empty", "header"),
        ("\n \n", None, "empty", "header"),
        (b"\x89PNG\r\n\x1a\n\0\0\0", 3, "binary", "CSV"),
        (HEAD.encode("utf-16"), 1, "UTF-16", "UTF-8"),
        (HEAD.encode() + b"0,1,2\n1,1,\xb0\n", 3, "0xb0 is not UTF-8", "UTF-8"),
    ],
)
def test_what_is_wrong_is_told(csv, text, line, problem, remedy) -> None:
    with pytest.raises(RecordingError, match=problem) as caught:
        read_text(csv, text)
    assert caught.value.where == (f"{csv}:{line}" if line else str(csv))
    assert re.search(remedy, caught.value.remedy)


ALPHABET = st.sampled_from([*"0123456789.,;-e#:[]_ \t\r\n", "t[s]", "u_v[V]", "alpha_v[deg]"])


@given(st.lists(ALPHABET, max_size=60).map("".join), st.booleans())
def test_any_text_is_read_or_clearly_refused(tmp_path_factory, text, with_header) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "x.csv"
    try:
        recording = read_text(path, HEAD + text if with_header else text)
    except RecordingError as error:
        assert error.where.startswith(str(path)) and error.remedy
    else:
        assert np.all(np.diff(recording.time) > 0)


@given(st.binary(max_size=100))
def test_any_bytes_are_read_or_clearly_refused(tmp_path_factory, data) -> None:
    with pytest.raises(RecordingError):
        read_text(tmp_path_factory.mktemp("fuzz") / "x.csv", data)


finite = st.floats(allow_nan=False, allow_infinity=False)
one_line = st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), min_size=1)


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    names = draw(st.lists(st.sampled_from(list(CHANNELS)), unique=True))
    names = list(dict.fromkeys(["u_v", "alpha_h", *names]))
    times = sorted(draw(st.lists(finite, min_size=2, max_size=20, unique=True)))
    cells = st.one_of(finite, st.just(math.nan))
    column = st.lists(cells, min_size=len(times) - 1, max_size=len(times) - 1)
    channels = {name: np.array([draw(finite), *draw(column)]) for name in names}
    units = {name: CHANNELS[name].units[0] for name in names}
    metadata = draw(st.dictionaries(one_line.filter(lambda k: ":" not in k), one_line, max_size=3))
    return Recording(np.array(times), channels, units, metadata)


@given(recordings())
def test_what_is_written_is_read_bit_for_bit(tmp_path_factory, recording) -> None:
    path = tmp_path_factory.mktemp("round") / "x.csv"
    write_csv(recording, path)
    back = read_csv(path)
    np.testing.assert_array_equal(back.time, recording.time)
    assert list(back.channels) == list(recording.channels)
    for name, values in recording.channels.items():
        np.testing.assert_array_equal(back.channels[name], values)
    assert back.units == recording.units and back.metadata == recording.metadata


@pytest.mark.parametrize("cell", ["", "nan", "NaN", "NAN", "-nan", ' "nan" '])
def test_nan_is_a_missing_sample(tmp_path, cell):
    path = tmp_path / "rec.csv"
    path.write_text(f"t[s],u_v[V],alpha_v[rad]\n0,1,2\n1,1,{cell}\n2,1,3\n")
    recording = read_csv(path)
    np.testing.assert_array_equal(recording.channels["alpha_v"], [2, np.nan, 3])
