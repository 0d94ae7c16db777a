"""Bad recordings are refused with what to do instead; good ones pass without a word."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.recordings.played_rig import BENCH, SIGNALS, play
from trms_cli.core.errors import RecordingError
from trms_cli.identification.admission.admit import admit
from trms_cli.identification.admission.issues import merge_admissions
from trms_cli.identification.admission.motion import issues_by_model
from trms_cli.identification.data import DataOptions, load_datasets
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.recorded_motion import RecordedMotions
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.tras import Tras
from trms_cli.recordings.for_model import Selection
from trms_cli.recordings.recording import Recording

MODEL = Newtonian()
#: Recordings of real rigs beside the checkout, where there are any.
SHELF = Path(__file__).parents[3] / "shared" / "records"
Change = Callable[[dict[str, np.ndarray]], object]


def dataset(recording: Recording, change: Change = lambda channels: None, model=MODEL) -> Dataset:
    """A recording, changed, as a dataset."""
    channels = {name: values.copy() for name, values in recording.channels.items()}
    change(channels)
    spoilt = Recording(recording.time, channels, recording.units, {}, recording.source)
    run = Selection(sensors=BENCH).take(spoilt, model)
    noise = np.array([run.noise_sd[signal.name] for signal in run.outputs])
    return Dataset(
        "played", "played.csv", "", run.sample_time, run.time, run.inputs, run.outputs,
        run.commands, run.measurements, noise,
    )  # fmt: skip


@pytest.fixture(scope="module")
def recordings() -> dict[str, Recording]:
    """A rig that differs from the model, under every kind of command."""
    return {kind: play(kind, seed=3, prior_seed=3) for kind in (*SIGNALS, "closed")}


def scaled(name: str, factor: float) -> Change:
    return lambda channels: channels.update({name: factor * channels[name]})


def swapped(a: str, b: str) -> Change:
    return lambda channels: channels.update({a: channels[b], b: channels[a]})


def without_speeds(change: Change) -> Change:
    def both(channels):
        change(channels)
        del channels["omega_v"], channels["omega_h"]

    return both


KINDS = pytest.mark.parametrize("kind", [*SIGNALS, "closed"])


class TestGoodRecordings:
    @pytest.mark.parametrize(
        "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 40))]
    )
    @KINDS
    def test_rigs_drawn_from_the_priors_pass_without_a_word(self, kind, seed):
        recording = play(kind, seed=seed, prior_seed=seed)
        assert admit([dataset(recording)], MODEL, 15).issues == ()
        bare = dataset(recording, without_speeds(lambda channels: None))
        assert admit([bare], MODEL, 15).issues == ()

    @pytest.mark.parametrize("freedom", ["vertical", "horizontal"])
    def test_models_of_one_axis(self, freedom, recordings):
        model = Newtonian(freedom=freedom)
        assert admit([dataset(recordings["prbs"], model=model)], model).errors == ()
        if freedom == "vertical":
            assert admit([dataset(play("prbs", model=model), model=model)], model).issues == ()

    def test_the_sister_rig(self):
        model = Tras()
        recording = play("closed", model=model, scale=(0.4, 0.4), step=0.01)
        assert admit([dataset(recording, model=model)], model).errors == ()

    @pytest.mark.skipif(not SHELF.is_dir(), reason="the shelf of recordings is not there")
    def test_a_real_closed_loop_recording_and_its_parts(self):
        (whole,) = load_datasets(str(SHELF / "tras/closed_loop.csv"), Tras(), DataOptions())
        assert admit([whole], Tras(), 15).issues == ()
        assert admit([whole], Tras(), purpose="validation").issues == ()
        part = whole.part(1000, 1500)
        assert admit([part], Tras(), purpose="validation").errors == ()


WRONG: dict[str, tuple[Change, str, str]] = {
    "inputs swapped": (swapped("u_v", "u_h"), "swapped", "u_v"),
    "angles swapped": (swapped("alpha_v", "alpha_h"), "swapped", "alpha_v"),
    "inputs swapped, no speeds": (without_speeds(swapped("u_v", "u_h")), "swapped", "u_v"),
    "angles swapped, no speeds": (
        without_speeds(swapped("alpha_v", "alpha_h")), "swapped", "alpha_v",
    ),
    "pitch turned round": (scaled("alpha_v", -1), "sign", "alpha_v"),
    "yaw turned round": (scaled("alpha_h", -1), "sign", "alpha_h"),
    "yaw turned round, no speeds": (without_speeds(scaled("alpha_h", -1)), "sign", "alpha_h"),
    "tail command turned round, no speeds": (
        without_speeds(scaled("u_h", -1)), "sign", "alpha_h",
    ),
    "main speed turned round": (scaled("omega_v", -1), "sign", "omega_v"),
    "tail speed turned round": (scaled("omega_h", -1), "sign", "omega_h"),
    "pitch in degrees": (scaled("alpha_v", 180 / np.pi), "unit", "alpha_v"),
    "yaw in degrees": (scaled("alpha_h", 180 / np.pi), "unit", "alpha_h"),
    "main speed in rpm": (scaled("omega_v", 30 / np.pi), "unit", "omega_v"),
    "tail speed in rpm": (scaled("omega_h", 30 / np.pi), "unit", "omega_h"),
    "tail speed divided": (scaled("omega_h", np.pi / 30), "unit", "omega_h"),
    "command in percent": (scaled("u_v", 40), "unit", "u_v"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "purpose"), [("multilevel", "fit"), ("closed", "fit"), ("multilevel", "validation")]
)
@pytest.mark.parametrize("what", WRONG)
def test_wrong_channels_are_named(what, kind, purpose, recordings):
    change, check, channel = WRONG[what]
    errors = admit([dataset(recordings[kind], change)], MODEL, 15, purpose).errors
    assert [(e.check, e.channel) for e in errors] == [(check, channel)]
    assert errors[0].remedy


def filled(**values: float) -> Change:
    return lambda channels: [channels[name].fill(value) for name, value in values.items()]


def half_lost(channels):
    channels["omega_v"][np.arange(len(channels["omega_v"])) % 3 > 0] = np.nan


def pushed(channels):
    channels["u_h"][100:140] = 3.5


class TestDeadAndDull:
    @pytest.mark.parametrize(
        ("change", "check", "channel", "words"),
        [
            (filled(alpha_h=0.2), "constant", "alpha_h", "=[alpha_v, omega_v, omega_h]"),
            (filled(omega_v=np.nan), "missing", "omega_v", "leave it out"),
            (filled(u_v=0.8, u_h=0.0), "excitation", "", "trms excite"),
            (filled(u_v=2.5, u_h=-2.5), "saturation", "", "trms excite"),
        ],
        ids=["a constant channel", "no value", "inputs that never move", "saturated throughout"],
    )
    def test_what_makes_a_fit_impossible_is_an_error(
        self, change, check, channel, words, recordings
    ):
        error = admit([dataset(recordings["prbs"], change)], MODEL).errors[0]
        assert (error.check, error.channel) == (check, channel) and words in error.remedy

    @pytest.mark.parametrize(
        ("change", "check", "channel"),
        [
            (half_lost, "missing", "omega_v"),
            (filled(u_h=0.0), "excitation", "u_h"),
            (pushed, "limit", "u_h"),
        ],
        ids=["half missing", "one input at rest", "recorded before the limits"],
    )
    def test_what_is_a_matter_of_degree_is_a_warning(self, change, check, channel, recordings):
        found = admit([dataset(recordings["prbs"], change)], MODEL)
        assert [w.channel for w in found.warnings if w.check == check] == [channel]
        assert check != "missing" or len(found.issues) == 1

    def test_a_free_oscillation_is_admitted_with_a_word(self, recordings):
        def still(channels):
            filled(u_v=0.0, u_h=0.0)(channels)
            t = np.arange(len(channels["u_v"])) * 0.02
            channels["alpha_v"][:] = -0.62 + 0.2 * np.exp(-0.05 * t) * np.cos(2 * t)

        found = admit([dataset(recordings["prbs"], still)], MODEL)
        assert not [e for e in found.errors if e.check == "excitation"]
        assert any("only the free motion" in w.problem for w in found.warnings)

    def test_bang_bang_between_the_limits_is_no_saturation(self):
        recording = play("prbs", scale=(1.0, 1.0))
        recording.channels["u_h"] = 2.5 * np.sign(np.sin(recording.time))
        assert not [i for i in admit([dataset(recording)], MODEL).issues if i.check == "saturation"]


class TestLengthAndRate:
    @pytest.mark.parametrize(
        ("first", "last", "free", "words"),
        [(0, 140, 15, "record at least 150 samples"), (500, 650, 0, "at a stretch")],
        ids=["too few samples for the parameters", "too short for the slowest mode"],
    )
    def test_too_short_is_an_error(self, first, last, free, words, recordings):
        errors = admit([dataset(recordings["prbs"]).part(first, last)], MODEL, free).errors
        assert errors[0].check == "length" and words in errors[0].remedy
        assert free or len(errors) == 1

    def test_a_bit_short_is_a_warning_for_which_nothing_is_raised(self, recordings):
        found = admit([dataset(recordings["prbs"]).part(500, 1300)], MODEL)
        assert not found.errors and [w.check for w in found.warnings] == ["length"]
        found.require()

    def test_different_rates_are_told(self, recordings):
        one = dataset(recordings["prbs"])
        other = replace(one, sample_time=0.04, name="other")
        found = admit([one, other], MODEL)
        assert any("0.02, 0.04 s" in w.problem for w in found.warnings)
        stepped = Newtonian()
        stepped.sample_time = 0.05
        error = admit([one], stepped).errors[0]
        assert error.check == "sample time" and "data.resample=0.05" in error.remedy

    def test_slow_sampling_is_told(self):
        fine = play("prbs", duration=600.0)
        rows = slice(None, None, 40)
        channels = {name: values[rows] for name, values in fine.channels.items()}
        coarse = Recording(fine.time[rows], channels, fine.units, {}, fine.source)
        found = admit([dataset(coarse)], MODEL)
        assert any(w.check == "sample time" for w in found.warnings)


def test_all_errors_are_told_at_once(recordings):
    spoilt = dataset(recordings["prbs"], filled(alpha_h=0.0, omega_v=np.nan))
    with pytest.raises(RecordingError) as error:
        admit([spoilt], MODEL).require()
    assert "alpha_h is constant" in str(error.value) and "omega_v has not" in str(error.value)
    assert error.value.exit_code == 2


def test_a_model_that_runs_away_tells_nothing_of_the_channels(recordings):
    model = Newtonian(parameters={"J_mr": 1e-9, "J_tr": 1e-9})
    found = admit([dataset(recordings["multilevel"], model=model)], model).issues
    assert not {issue.check for issue in found} & {"sign", "unit", "swapped", "speed"}


class TestForAValidation:
    """What cannot be fitted may still be held against a model; what is read wrongly may not."""

    @KINDS
    def test_short_parts_pass(self, kind, recordings):
        """A sign is no error where an axis may swing against its thrust for other reasons."""
        whole = dataset(recordings[kind])
        for seconds in (1.0, 3.0, 6.0):
            n = round(seconds / whole.sample_time)
            for first in range(0, len(whole) - n, len(whole) // 6):
                part = whole.part(first, first + n)
                assert admit([part], MODEL, purpose="validation").errors == (), first

    @pytest.mark.parametrize(
        "still, words",
        [
            ({"u_v": 0.8, "u_h": 0.0}, "never move"),
            ({"u_v": 2.5, "u_h": -2.5}, "at the limit throughout"),
            ({"omega_h": 0.0}, "omega_h is constant"),
            ({"alpha_h": 0.2, "omega_h": 0.0, "u_h": 0.0}, "alpha_h is constant"),
        ],
        ids=str,
    )
    def test_rest_is_worth_a_word(self, still, words, recordings):
        spoilt = dataset(recordings["prbs"], filled(**still))
        assert admit([spoilt], MODEL).errors
        found = admit([spoilt], MODEL, purpose="validation")
        assert found.errors == () and any(words in w.problem for w in found.warnings)

    def test_the_others_are_looked_at_beside_a_constant_one(self, recordings):
        def spoil(channels):
            filled(omega_h=0.0)(channels)
            scaled("alpha_v", -1)(channels)

        errors = admit([dataset(recordings["prbs"], spoil)], MODEL, purpose="validation").errors
        assert [(e.check, e.channel) for e in errors] == [("sign", "alpha_v")]

    def test_where_nothing_moves_nothing_is_told(self, recordings):
        spoilt = dataset(recordings["prbs"], lambda c: [v.fill(0.1) for v in c.values()])
        (error,) = admit([spoilt], MODEL, purpose="validation").errors
        assert "nothing moves" in error.problem


def test_of_several_models_only_those_are_named_that_an_issue_is_of(recordings):
    spoilt = dataset(recordings["prbs"], filled(u_v=0.0, alpha_h=0.1))
    small = Newtonian()
    small.input_limits = {"u_v": 2.5, "u_h": 0.2}
    found = {"mine": admit([spoilt], MODEL), "small": admit([spoilt], small)}
    assert merge_admissions({"mine": found["mine"]}) == found["mine"]
    both = merge_admissions(found)
    constant = next(i for i in both.errors if i.check == "constant")
    assert constant.problem.startswith("alpha_h is constant")
    beyond = next(i for i in both.issues if i.channel == "u_h")
    assert beyond.problem.startswith("small: u_h ")
    assert [i.severity for i in both.issues] == sorted(i.severity for i in both.issues)


def with_zero_at(kind: str, by: float, model: Model = MODEL, **options: object) -> Dataset:
    """A recording whose pitch is counted from another zero than the level beam."""
    recording = play(kind, model=model, **options)
    return dataset(recording, lambda c: c.update(alpha_v=c["alpha_v"] + by), model)


@pytest.mark.parametrize("kind", ["prbs", "multilevel", "closed"])
def test_zero_at_the_hanging_rest_is_told_with_its_cure(kind):
    (finding,) = issues_by_model(with_zero_at(kind, 0.62, seed=2, prior_seed=2), MODEL)
    assert (finding.check, finding.channel, finding.severity) == ("zero", "alpha_v", "warning")
    assert "data.offset={alpha_v: -0.62}" in finding.remedy and "hung" in finding.problem


def test_another_zero_is_told_by_its_size_but_not_what_the_priors_allow():
    (finding,) = issues_by_model(with_zero_at("prbs", -0.5, seed=1), MODEL)
    added = float(finding.remedy.split("alpha_v: ")[1].split("}")[0])
    assert added == pytest.approx(0.5, abs=0.05)
    for seed in range(2):
        within = with_zero_at("multilevel", 0.05, seed=seed, prior_seed=seed)
        assert not issues_by_model(within, MODEL)


def test_the_sister_rig_has_its_own_rest():
    model = Tras()
    rest = float(model.rest()[model.state_index("alpha_v")])
    rig = with_zero_at("closed", -rest, model, scale=(0.4, 0.4), step=0.01)
    (finding,) = issues_by_model(rig, model)
    assert f"data.offset={{alpha_v: {rest:.2f}}}" in finding.remedy


def test_weight_at_rest_vanishes_where_the_beam_hangs():
    rest = MODEL.rest()[MODEL.state_index("alpha_v")]
    left, there, right = RecordedMotions(MODEL).at_rest(
        "alpha_v", rest + np.array([-0.2, 0.0, 0.2])
    )
    assert left > 0 > right
    assert there == pytest.approx(0, abs=0.05 * left)


def recorded(folder: Path, step: float, unit: str = "s") -> str:
    t = step * np.arange(400)
    u = np.sign(np.sin(t))
    rows = "\n".join(f"{a:.6g},{b:g},0,{c:.4f}" for a, b, c in zip(t, u, 0.1 * u, strict=True))
    file = folder / "clock.csv"
    file.write_text(f"t[{unit}],u_v[V],u_h[V],alpha_v[rad]\n{rows}\n")
    return str(file)


def test_milliseconds_read_as_seconds_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="20 s a sample") as error:
        load_datasets(recorded(tmp_path, 20.0), Newtonian())
    assert "t[ms]" in str(error.value.remedy)
    # What is fast enough to be simulated is read.
    for step, unit in ((20.0, "ms"), (0.02, "s"), (0.8, "s")):
        (dataset,) = load_datasets(recorded(tmp_path, step, unit), Newtonian())
        assert len(dataset) == 400
