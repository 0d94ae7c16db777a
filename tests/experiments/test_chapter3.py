"""Chapter 3: its recordings, its trainings, its page, the networks that travel with the program."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.chapter3 import networks as shipped
from experiments.chapter3.figures import draw_all
from experiments.chapter3.page import fill_tables
from experiments.chapter3.recordings import cut_at_stops, recording
from experiments.chapter3.structure_selection import AssessedCandidate, Candidate, select_candidate
from experiments.chapter3.study import Study, _excitation_jobs, _member_jobs, _table_jobs
from experiments.chapter3.tables import markdown, plain
from experiments.chapter3.trainings import PARTS, Job, make_recording, model_of, run_job, settings
from trms_cli.core.errors import RecordingError
from trms_cli.core.resources import config_folder
from trms_cli.models.model import names
from trms_cli.models.narx_file import read_narx_file

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "chapter3.md"
#: Share of the recordings' durations.
SHORT = 0.15


def quick(system: str, label: str, training: str = "lm") -> Job:
    return Job(system, label, "narx", training, 0, {"stopping": {"epochs": 5}})


@pytest.fixture(scope="module")
def study() -> Study:
    """Everything of the study, small."""
    tables = {
        system: [run_job(quick(system, name, name), SHORT) for name in ("scg", "lm")]
        for system in settings()["systems"]
    }
    members = {
        "vertical": [
            run_job(quick("vertical", "nnarx"), SHORT),
            run_job(
                Job("vertical", "nnoe", "nnoe", "lm", 0, {"horizons": [1.0], "first_epochs": 3,
                    "stopping": {"epochs": 3}}),
                SHORT,
            ),
            run_job(
                Job("vertical", "nnssif", "nnssif", "lm", 0, {"first_epochs": 3,
                    "stopping": {"epochs": 2}}),
                SHORT,
            ),
        ]
    }  # fmt: skip
    excitations = [run_job(quick("vertical", "multilevel"), SHORT)]
    structures = [
        AssessedCandidate(Candidate(1, 2), 12, (0.01, 0.02), (0.4, 0.5)),
        AssessedCandidate(Candidate(2, 4), 38, (0.01, 0.02), (0.1, np.inf)),
        AssessedCandidate(Candidate(1, 4), 22, (0.01, 0.02), (0.3, 0.3)),
        AssessedCandidate(Candidate(2, 2), 20, (0.01, 0.02), (0.2, 0.21)),
    ]
    activations = {"vertical": [run_job(quick("vertical", "tanh"), SHORT)]}
    return Study(tables, members, activations, excitations, structures)


class TestStudy:
    """The list of trainings is the thesis's; a training is told in full."""

    def test_all_thirteen_on_each_system(self):
        trainings = {name: own["trainings"] for name, own in settings()["systems"].items()}
        options = {path.stem for path in (config_folder() / "training").glob("*.yaml")}
        assert len(options) == 13
        assert all(set(names) == options for names in trainings.values())
        # Every start of every training is a job.
        assert len(_table_jobs("vertical", [0, 1])) == 26
        members = _member_jobs("both", [0])
        assert {job.label for job in members} == {"nnfir", "nnarx", "nnarmax", "nnssif", "nnoe"}
        assert {job.label for job in _excitation_jobs([0])} == {"prbs", "multilevel"}

    def test_the_test_recording_takes_no_part_in_any_training(self):
        parts = [
            make_recording("vertical", part, SHORT) for part in ("fitted", "validation", "test")
        ]
        for i, one in enumerate(parts):
            for other in parts[i + 1 :]:
                n = min(len(one), len(other))
                assert np.abs(one.commands[:n] - other.commands[:n]).mean() > 0.05

    @pytest.mark.parametrize("system", settings()["systems"])
    def test_no_recording_hits_the_frame(self, system):
        stops = model_of(system).stops
        for part in PARTS:
            dataset = make_recording(system, part)
            assert len(cut_at_stops(dataset, stops, 0.0)) == 1, part
        if system == settings()["excitations"]["system"]:
            own = settings()["systems"][system] | {"excitation": settings()["excitations"]["prbs"]}
            dataset = recording_of(own, 180.0)
            assert len(cut_at_stops(dataset, stops, 0.0)) == 1

    def test_a_training_is_judged_on_all_three_recordings(self, study):
        one = study.tables["both"][1]
        assert set(one.one_step) == set(one.free_run) == {"fitted", "validation", "test"}
        assert set(one.one_step["test"]) == {"alpha_v", "alpha_h", "omega_v", "omega_h"}
        assert one.losses[-1] < one.losses[0]
        assert one.epochs == len(one.losses) - 1

    @pytest.mark.slow
    def test_all_thirteen_trainings_of_one_axis_take_less_than_three_minutes(self):
        trained = [run_job(job) for job in _table_jobs("horizontal", [0])]
        assert len(trained) == 13
        assert sum(one.seconds for one in trained) < 180
        # those that reach the floor of the encoder one step ahead; gradient descent does not
        good = {"cgf", "cgp", "cgb", "scg", "bfgs", "oss", "lm", "br"}
        for one in trained:
            assert (one.one_step["test"]["alpha_h"] < 1.3e-3) or one.job.training not in good

    def test_tables_and_document_say_the_same(self, study):
        tables, document = markdown(study), plain(study)
        json.dumps(document, allow_nan=False)
        lm = document["tables"]["vertical"][1]
        assert lm["training"] == "lm"
        row = next(line for line in tables["vertical"].splitlines() if line.startswith("| `lm`"))
        assert f"{1e3 * lm['free_run']['test']['alpha_v']:.3g}" in row
        assert tables["structure"].splitlines()[-1].startswith("| selected | 2 | 2 |")

    def test_every_figure_is_drawn(self, study, tmp_path, monkeypatch):
        drawn: list[str] = []
        monkeypatch.setattr(
            "experiments.chapter3.training_picture.save_png",
            lambda figure, path: drawn.append(path.name),
        )
        draw_all(study, tmp_path, SHORT)
        page = PAGE.read_text(encoding="utf-8")
        page_figures = {word.split(")")[0] for word in page.split("figures/chapter3/")[1:]}
        assert {name for name in page_figures if name.endswith(".png")} >= {
            "structure.png",
            "learning_vertical.png",
            *(
                f"{kind}_{system}.png"
                for kind in ("responses", "structures")
                for system in settings()["systems"]
            ),
        }
        assert set(drawn) <= {path.name for path in (PAGE.parent / "figures/chapter3").iterdir()}


def test_tables_go_between_their_marks_on_the_page_and_nowhere_else(study):
    text = "a\n<!-- table x -->\nold\n<!-- end -->\nb\n<!-- table y -->\n<!-- end -->\n"
    assert fill_tables(text, {"x": "new \\1"}, "p") == text.replace("old", "new \\1")
    with pytest.raises(RecordingError, match="no place for the table 'x'"):
        fill_tables("", {"x": "t"}, "p")
    fill_tables(PAGE.read_text(encoding="utf-8"), markdown(study), str(PAGE))


def recording_of(own: dict, duration: float, seed: int = 0):
    """A recording of these settings."""
    return recording(
        own["model"], own["excitation"], duration=duration, sample_time=0.02, seed=seed, name="r"
    )


class TestRecordings:
    """Simulated as a bench would record."""

    def test_the_seed_draws_commands_and_noise(self):
        own = settings()["systems"]["horizontal"]
        once, again, other = (recording_of(own, 3.0, seed) for seed in (0, 0, 1))
        assert np.array_equal(once.measurements, again.measurements)
        assert not np.array_equal(once.commands, other.commands)
        quantum = 2 * np.pi / 4096
        steps = once.output("alpha_h") / quantum
        assert steps == pytest.approx(np.round(steps), abs=1e-6)

    def test_pieces_end_where_the_beam_touches_its_stops(self):
        whole = recording_of(settings()["systems"]["horizontal"], 4.0)
        angle = whole.output("alpha_h")
        angle[:] = 0.0
        angle[90:95] = 1.0
        pieces = cut_at_stops(whole, {"alpha_h": 1.0}, shortest=0.5)
        assert [len(piece) for piece in pieces] == [90, 105]
        assert len(cut_at_stops(whole, {"alpha_h": 1.0}, shortest=2.0)) == 1


@pytest.mark.parametrize("name", shipped.settings()["networks"])
class TestShippedNetworks:
    """The networks in configs/networks are those that the settings describe, and they are good."""

    def test_is_of_its_settings(self, name):
        content, own = read_narx_file(name), shipped.settings()
        regressors = own["method"]["regressors"]
        assert list(content.structure.output_lags) == regressors["output_lags"]
        assert content.structure.sample_time == own["sample_time"]
        assert content.rig == own["networks"][name]["model"]
        hidden = own["networks"][name]["method"]["hidden"]
        assert [len(content.network.weights["b1"])] == hidden

    def test_foretells_four_seconds_of_a_recording_that_it_never_saw(self, name):
        """Another draw of the commands, run-up included: what a predictive controller needs."""
        own = shipped.settings()["networks"][name]
        content = read_narx_file(name)
        fresh = recording_of(own, 60.0, seed=77)
        pieces = cut_at_stops(fresh, content.limits, 6.0)
        errors = shipped.window_errors(content.structure, content.network, pieces, 4.0, 0.3)
        for channel, error in errors.items():
            # of the speeds 1.6 rad/s is the tachometer's noise
            assert error < (0.03 if channel.startswith("alpha") else 2.5), channel
        assert set(errors) == set(names(fresh.outputs))


def test_the_smallest_structure_within_the_spread_of_the_best_is_selected():
    def assessed(lags: int, hidden: int, weights: int, *errors: float) -> AssessedCandidate:
        return AssessedCandidate(Candidate(lags, hidden), weights, errors, errors)

    large = assessed(3, 16, 200, 0.10, 0.11, 0.14)
    small = assessed(2, 4, 40, 0.12, 0.13, 0.13)
    smaller = assessed(1, 2, 15, 0.30, 0.31, 0.32)
    lost = assessed(2, 2, 20, np.inf, 0.1, np.inf)
    assert select_candidate([large, small, smaller, lost]) is small
