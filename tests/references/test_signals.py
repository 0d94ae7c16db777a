"""Signals are what their formulas or files say, pure functions of time, within their amplitude."""

from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.references.chirp import Chirp
from trms_cli.references.constant import Constant
from trms_cli.references.from_csv import FromCsv, read_columns
from trms_cli.references.multilevel import Multilevel
from trms_cli.references.multisine import Multisine
from trms_cli.references.prbs import Prbs
from trms_cli.references.ramp import Ramp
from trms_cli.references.sawtooth import Sawtooth
from trms_cli.references.schedule import Piece, Schedule
from trms_cli.references.signal import ReferenceSignal
from trms_cli.references.sine import Sine
from trms_cli.references.square import Square
from trms_cli.references.step import Step
from trms_cli.references.sum import Sum

COMMON = {"amplitude": 0.3, "offset": 0.2, "start": 2.0}
SIGNALS: dict[str, ReferenceSignal] = {
    "constant": Constant(offset=0.2),
    "step": Step(**COMMON),
    "square": Square(**COMMON, frequency=0.5),
    "sine": Sine(**COMMON, frequency=0.5),
    "sawtooth": Sawtooth(**COMMON, frequency=0.5),
    "triangle": Sawtooth(**COMMON, frequency=0.5, width=0.5),
    "ramp": Ramp(**COMMON, duration=4.0),
    "multisine": Multisine(**COMMON, frequency=0.1, lowest=0.1, highest=2.0),
    "prbs": Prbs(**COMMON, hold=0.3, bits=5),
    "multilevel": Multilevel(**COMMON, shortest=0.05, longest=0.4, seed=4),
    "chirp": Chirp(**COMMON, frequency=0.1, final_frequency=2.0, duration=5.0),
    "sum": Sum(terms=[Constant(offset=0.2), Sine(amplitude=0.3, frequency=0.5, start=2.0)]),
    "schedule": Schedule(
        pieces=[Piece(start=2.0, signal=Sine(amplitude=0.3, frequency=0.5, offset=0.2))], offset=0.2
    ),
}
every_signal = pytest.mark.parametrize("signal", SIGNALS.values(), ids=SIGNALS)
TIMES = np.arange(0, 20, 0.01)
LONG = np.arange(0, 400, 0.01)


@every_signal
def test_the_answer_for_a_time_does_not_depend_on_the_other_times_nor_on_a_schedule(signal):
    together = signal.sample(TIMES)
    order = np.random.default_rng(0).permutation(TIMES.size)
    assert together.shape == TIMES.shape
    np.testing.assert_array_equal(signal.sample(TIMES[order]), together[order])
    alone = [signal.sample(np.array([t]))[0] for t in TIMES[::97]]
    np.testing.assert_array_equal(alone, together[::97])
    assert signal.sample(np.zeros(0)).shape == (0,)
    # 3 · 0.1 − 0.3 is a rounding error away from the signal's own start of 2 s
    times = 0.1 * np.arange(60)
    piece = Schedule(pieces=[Piece(start=0.3, signal=signal)], offset=0.2).sample(times)
    np.testing.assert_allclose(piece[3:], signal.sample(times[:-3]), atol=1e-9)


@every_signal
def test_a_signal_stays_within_its_amplitude_and_rests_at_its_offset_before(signal):
    values = signal.sample(TIMES)
    assert np.all(np.abs(values - 0.2) <= 0.3 * 1.006)
    np.testing.assert_array_equal(values[TIMES < 1.999], 0.2)
    assert np.all(np.isfinite(signal.sample(np.array([-1.0, 1e6]))))


@pytest.mark.parametrize("name", ["square", "sine", "sawtooth", "triangle", "multisine", "prbs"])
def test_what_repeats_repeats(name):
    period = {"multisine": 10.0, "prbs": 31 * 0.3}.get(name, 2.0)
    # away from edges, at which rounding of t + period may choose either side
    times = np.arange(200) * 0.0997 + 2.0013
    np.testing.assert_allclose(
        SIGNALS[name].sample(times), SIGNALS[name].sample(times + period), atol=1e-9
    )


@given(
    frequency=st.sampled_from([0.025, 0.05, 0.1, 0.125, 0.2, 0.25, 0.5, 1.0]),
    rate=st.sampled_from([10, 20, 50, 100, 1000]),
)
def test_a_square_has_its_edges_on_the_samples_they_were_meant_for(frequency, rate):
    half = rate / frequency / 2
    if half != int(half):
        return
    samples = np.arange(int(8 * half))
    # time as a loop makes it, with the rounding of a product
    values = Square(amplitude=1.0, frequency=frequency).sample(samples * (1 / rate))
    np.testing.assert_array_equal(values, np.where((samples // int(half)) % 2 == 0, 1.0, -1.0))


def test_a_step_comes_on_the_sample_nearest_to_its_time():
    times = np.cumsum(np.full(100, 0.1))  # 0.1, 0.2, 0.30000000000000004, …
    values = Step(amplitude=1.0, start=0.8).sample(times)
    assert np.argmax(values) == 7


def test_a_sawtooth_is_scipys_a_half_rise_later():
    times = np.append(0.0, np.arange(1000) * 0.00993 + 0.0013)
    for width in (1.0, 0.5, 0.2):
        ours = Sawtooth(amplitude=1.0, frequency=0.5, width=width).sample(times)
        theirs = scipy.signal.sawtooth(2 * np.pi * (0.5 * times + width / 2), width)
        np.testing.assert_allclose(ours, theirs, atol=1e-9)


@pytest.mark.parametrize("sweep", ["linear", "logarithmic"])
@pytest.mark.parametrize(("first", "last"), [(0.1, 3.0), (3.0, 0.1), (1.0, 1.0)])
def test_a_chirp_is_scipys(sweep, first, last):
    times = np.linspace(0, 10, 500)
    ours = Chirp(amplitude=1.0, frequency=first, final_frequency=last, duration=10.0, sweep=sweep)
    theirs = scipy.signal.chirp(times, first, 10.0, last, method=sweep, phi=-90)
    np.testing.assert_allclose(ours.sample(times), theirs, atol=1e-9)
    np.testing.assert_array_equal(ours.sample(np.array([11.0])), ours.sample(np.array([10.0])))


def test_a_multisine_excites_its_band_evenly_and_nothing_else():
    signal = Multisine(amplitude=1.0, frequency=0.1, lowest=0.5, highest=3.0)
    times = np.arange(1000) * 0.01  # one period
    spectrum = np.abs(np.fft.rfft(signal.sample(times)))
    inside = np.zeros(spectrum.size, dtype=bool)
    inside[5:31] = True
    np.testing.assert_allclose(spectrum[inside], spectrum[5], rtol=1e-6)
    assert spectrum[~inside].max() < 1e-6 * spectrum[5]


@given(st.integers(8, 80))
def test_a_multisine_has_a_low_crest_factor(harmonics):
    signal = Multisine(amplitude=1.0, frequency=0.1, lowest=0.1, highest=0.1 * harmonics)
    values = signal.sample(np.arange(40 * harmonics) * (10 / (40 * harmonics)))
    peak = np.max(np.abs(values))
    assert peak == pytest.approx(1.0, rel=0.006)
    # all in phase it would be sqrt(2K), from 4 to 12.6 here
    assert peak / np.sqrt(np.mean(values**2)) < 2.0


@pytest.mark.parametrize("bits", range(2, 17))
def test_a_prbs_is_the_shift_register_of_scipy(bits):
    times = np.arange(2**bits - 1) * 0.5 + 0.25
    levels = Prbs(amplitude=1.0, hold=0.5, bits=bits).sample(times)
    np.testing.assert_array_equal(levels, 2.0 * scipy.signal.max_len_seq(bits)[0] - 1)


def test_a_prbs_leads_by_its_phase():
    times = np.arange(500) * 0.1
    plain = Prbs(amplitude=1.0, hold=0.5, bits=5)
    shifted = Prbs(amplitude=1.0, hold=0.5, bits=5, phase=10 / 31)
    np.testing.assert_array_equal(shifted.sample(times), plain.sample(times + 5.0))


def test_pieces_count_their_own_time_or_that_of_the_run():
    wave = Ramp(amplitude=1.0, duration=10.0)
    times = np.array([0.0, 4.0, 5.0, 7.0])
    pieces = [Piece(start=5.0, signal=wave)]
    np.testing.assert_allclose(Schedule(pieces=pieces).sample(times), [0, 0, 0, 0.2])
    np.testing.assert_allclose(
        Schedule(pieces=pieces, clock="global").sample(times), [0, 0, 0.5, 0.7]
    )


def test_holding_times_of_a_multilevel_lie_between_the_shortest_and_the_longest():
    values = Multilevel(amplitude=1.0, shortest=0.5, longest=2.0).sample(LONG)
    holds = np.diff(np.flatnonzero(np.diff(values) != 0)) * 0.01
    assert holds.min() >= 0.49 and holds.max() <= 2.01
    assert np.mean(holds) == pytest.approx(1.25, abs=0.1)


@pytest.mark.parametrize("levels", [2, 5, 9])
def test_all_levels_of_a_multilevel_occur_at_equal_distances(levels):
    values = Multilevel(amplitude=0.4, shortest=0.1, longest=0.1, levels=levels, offset=0.1).sample(
        LONG
    )
    expected = 0.1 + np.linspace(-0.4, 0.4, levels)
    np.testing.assert_allclose(np.unique(values.round(12)), expected, atol=1e-12)


def test_any_value_of_a_multilevel_is_drawn_evenly_and_seeds_differ():
    a = Multilevel(amplitude=1.0, shortest=0.01, longest=0.01, seed=1).sample(LONG)
    b = Multilevel(amplitude=1.0, shortest=0.01, longest=0.01, seed=2).sample(LONG)
    assert np.abs(a).max() <= 1.0
    assert np.std(a) == pytest.approx(3**-0.5, rel=0.02)
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.02


@pytest.mark.parametrize(
    ("words", "signal", "keys"),
    [
        ("no multiple", Multisine, {**COMMON, "frequency": 1.0, "lowest": 0.2, "highest": 0.7}),
        ("below its begin", Multisine, {**COMMON, "frequency": 0.1, "lowest": 0.8, "highest": 0.7}),
        ("no signals", Sum, {"terms": []}),
        ("int is not a signal", Sum, {"terms": [3]}),
        ("not after", Schedule, {"pieces": 2 * [Piece(start=3.0, signal=Constant())]}),
        ("no pieces", Schedule, {"pieces": []}),
        ("Piece", Schedule, {"pieces": [{"start": 0}]}),
        ("below the shortest", Multilevel, {**COMMON, "shortest": 2.0, "longest": 1.0}),
    ],
)
def test_mistakes_are_named(words, signal, keys):
    with pytest.raises(ConfigurationError, match=words):
        signal(**keys)


GOOD = "# rig: mine\n\nt[s],r_v[rad],note_free[V]\n10,0.1,1\n11,0.3,1\n13,-0.1,1\n"
SPREADSHEET = "\ufefft[s],r_v[rad]\r\n0,0.1\r\n1,0.2\r\n"


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


def test_it_is_moved_scaled_converted_and_read_as_a_spreadsheet_writes_it(tmp_path):
    signal = FromCsv(file=write(tmp_path, GOOD), column="r_v", start=5.0, scale=2.0, offset=1.0)
    np.testing.assert_allclose(signal.sample(np.array([5.0, 6.0])), [1.2, 1.6])
    file = write(tmp_path, "t[ms],r_h[deg]\n0,0\n500,90\n")
    signal = FromCsv(file=file, column="r_h")
    np.testing.assert_allclose(signal.sample(np.array([0.49, 0.5])), [0.0, np.pi / 2])
    signal = FromCsv(file=write(tmp_path, SPREADSHEET), column="r_v")
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
