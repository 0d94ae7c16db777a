"""Controllers of this program on rigs of other code, and what the study counts."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.gap import separation
from experiments.gap.__main__ import main
from experiments.gap.closing_loop import Sizes, Tracking, Verdict, tracking
from experiments.gap.driver import ModelBased, loop_of
from experiments.gap.page import Findings, document, mean_and_interval, recovered_share, tables
from experiments.gap.rigs import OwnDraws, drive_rigs, gentle_excitation, read_study, rig_of
from experiments.gap.separation import Separation, Standing, commands_of, pair_standing, slow_sines
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.model_file import load_model
from trms_cli.models.newtonian import Newtonian

STEP = 0.02


def _run(model: str, rmse: float) -> Tracking:
    both = {"pitch": rmse, "yaw": 2 * rmse}
    return Tracking("a-1", "a", 1, "squares", model, both, both, both, both)


def test_a_rig_meets_the_same_noise_in_any_company() -> None:
    alone = OwnDraws(3, [1], 3).normal(0, 1.0, 1)
    both = OwnDraws(3, [1, 0, 1], 3).normal(0, 1.0, 3)
    assert both[0] == both[2] == alone[0] != both[1]
    phases = OwnDraws(3, [2, 2], 3).uniform(0, 1, (2, 2))
    assert np.array_equal(phases[:, 0], phases[:, 1])
    with pytest.raises(ValueError):
        OwnDraws(3, [2, 2], 3).normal(0, 1.0, 4)


@pytest.mark.slow
def test_the_loop_follows_on_a_rig_of_other_code() -> None:
    """Two copies of a rig with one model do the same; a model of a heavier beam does not."""
    rig = rig_of("yaw_coulomb_friction", {"torque": 0.003}, 1, 0.5)
    loop = loop_of(["ref.alpha_v.amplitude=0.1", "ref.alpha_h.amplitude=0.3"])
    heavier = Newtonian(parameters={"m_cb": 0.075})
    samples = round(7.0 / STEP)
    driver = ModelBased([loop] * 3, [Newtonian(), Newtonian(), heavier], samples, STEP)
    run = drive_rigs([rig] * 3, driver, 7.0, STEP, among=[rig], seed=2)
    assert np.array_equal(run.measured[0], run.measured[1])
    assert not np.array_equal(run.commands[0], run.commands[2])
    assert np.abs(run.commands).max() <= 2.5
    error = run.measured[:, -50:, :2] - driver.references[:, -50:]
    assert np.abs(error).max() < 0.05  # it began 0.6 rad below


def test_the_true_model_is_the_rigs(tmp_path: Path) -> None:
    rig = rig_of("main_thrust_curve", {"exponent": 0.3, "reference": 200.0}, 2, 0.5)
    model = load_model(str(rig.write_true_model(tmp_path / "true.yaml")))
    for parameter in rig.parameters:
        assert model.parameters[parameter.name].value == parameter.value
    assert model.parameters["main_thrust_curve.exponent"].value == 0.3
    nominal = Newtonian().parameters
    apart = [abs(p.value / nominal[p.name].value - 1) for p in rig.parameters if p.prior_sd]
    assert 0 < max(apart) < 0.5


def test_excitations_keep_off_the_stops() -> None:
    commands = gentle_excitation(5, 20.0, STEP)
    assert commands.shape == (1000, 2)
    assert np.array_equal(commands, gentle_excitation(5, 20.0, STEP))
    spectrum = np.abs(np.fft.rfft(slow_sines(1, 6000, STEP, 0.12) - [1.25, 0.0], axis=0))
    frequency = np.fft.rfftfreq(6000, STEP)
    assert (spectrum[frequency > 0.2] ** 2).sum() < 0.01 * (spectrum**2).sum()


@pytest.mark.parametrize(
    ("words", "missing"),
    [(["--models", "nominal,told"], "told"), (["--only", "no_rig-*"], "no_rig-*")],
)
def test_what_the_study_has_not_is_said_before_anything_is_made(
    words, missing, tmp_path, capsys
) -> None:
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    assert repr(missing) in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_figures_of_a_run() -> None:
    study = {"run": {"from": 10.0}}
    rig = rig_of("a", {}, 1, 0.0)
    n = round(30.0 / STEP)
    references = np.zeros((n, 2))
    references[n // 2 :, 1] = 1.0
    angles = references + np.array([0.003, 0.0])
    angles[n // 2 : n // 2 + 50, 1] -= 0.5  # a second late, long before it counts as settled
    commands = np.tile([1.0, 0.0], (n, 1))
    commands[::2, 1] = 0.1
    tracking_figures = tracking(rig, "squares", "true", references, angles, commands, STEP, study)
    assert tracking_figures.rmse["pitch"] == pytest.approx(0.003)
    assert tracking_figures.rmse["yaw"] == pytest.approx(0.5 * np.sqrt(1 / 20))
    assert tracking_figures.settled == pytest.approx({"pitch": 0.003, "yaw": 0.0})
    assert tracking_figures.effort["pitch"] == 1.0
    assert tracking_figures.movement == pytest.approx({"pitch": 0.0, "yaw": 0.1 / STEP}, rel=2e-3)


def test_the_share_recovered() -> None:
    runs = [_run("nominal", 0.03), _run("diagnosed", 0.02), _run("true", 0.01)]
    assert recovered_share(runs) == pytest.approx((9 - 4) / (9 - 1))
    assert (
        recovered_share([_run("nominal", 0.011), _run("diagnosed", 0.01), _run("true", 0.01)])
        is None
    )
    mean, half = mean_and_interval([1.0, 2.0, 3.0])
    assert (mean, half) == pytest.approx((2.0, 4.302653 / np.sqrt(3)))
    assert np.isnan(mean_and_interval([1.0])[1])


def test_tables_and_document_say_the_same() -> None:
    runs = [_run("nominal", 0.03), _run("diagnosed", 0.02), _run("true", float("nan"))]
    now = Standing("undecided", 0.4, 0.5, 0.0, True, ("b",))
    after = Standing("effect", 0.9, 0.05, 0.0, False, ("a",))
    pair = Separation("a-1", "a", "b", "why", "trms excite", now, after)
    sizes = Sizes("a-1", "a", {"torque": 0.006}, {"told": {"torque": 0.0058}, "diagnosed": {}})
    verdict = Verdict("a-1", "a", "effect", ("a",), 0.9, 12.0)
    findings = Findings(runs, [verdict], [sizes], [pair])
    table_rows = tables(findings)
    assert table_rows["squares"][1][2] == "30.0"
    assert table_rows["squares"][2][2] == "60.0"
    assert [row[3] for row in table_rows["separation"][1:]] == ["0.40", "0.90"]
    assert table_rows["sizes"][1:] == [["`a`", "torque", "0.006", "0.0058", "–"]]
    findings_document = document(findings)
    assert findings_document["runs"][2]["rmse"]["pitch"] is None
    assert findings_document["separations"][0]["after"]["true"] == 0.9


def test_what_a_diagnosis_holds_of_a_pair(tmp_path: Path) -> None:
    believed = [(["b"], 0.6), (["a"], 0.3), (["b", "a"], 0.1)]
    content = {
        "verdict": "effect",
        "causes": [{"effects": names, "probability": p} for names, p in believed],
        "confusable": [["b", "c", "a"]],
        "next_experiment": None,
    }
    (tmp_path / "diagnosis.json").write_text(json.dumps(content))
    standing, advice = pair_standing(tmp_path, "a", "b")
    assert (standing.true, standing.rival, standing.both, standing.confusable) == (
        0.3,
        0.6,
        0.1,
        True,
    )
    assert standing.first == ("b",)
    assert advice is None


def test_an_advised_command_becomes_commands(tmp_path: Path) -> None:
    square = "trms run model=newtonian controller=open_loop signal@controller.u_v=square "
    square += "controller.u_v.amplitude=0.4 controller.u_v.frequency=0.5 sim.duration=4"
    commands = commands_of(square, tmp_path / "run", STEP)
    assert commands.shape == (200, 2)
    assert set(np.unique(commands[:, 0])) == {-0.4, 0.4}
    designed = "trms excite excitation=prbs duration=10 lead_in=2 'amplitude={u_v: 0.2, u_h: 0.3}'"
    commands = commands_of(designed, tmp_path / "excite", STEP)
    assert commands.shape == (600, 2)
    assert np.abs(np.diff(commands[200:, 1])).max() == pytest.approx(0.6)
    with pytest.raises(ConfigurationError):
        commands_of("rm -rf everything", tmp_path, STEP)
    with pytest.raises(ConfigurationError):
        commands_of(square, tmp_path / "run", 0.01)


def test_the_advised_experiment_is_played_to_the_rig(tmp_path, monkeypatch) -> None:
    """Diagnoses are stood in for: the second one has seen a recording of the advised commands."""
    advice = "trms run controller=open_loop signal@controller.u_v=square sim.duration=1"

    def diagnosed(recordings: list[Path], out: Path, words: list[str]) -> Path:
        out.mkdir()
        first = len(recordings) == 1
        if not first:
            head, *rows = recordings[1].read_text().splitlines()
            assert head.startswith("t[s],u_v[V],u_h[V],alpha_v[rad]")
            assert len(rows) == 50
            table = np.array([row.split(",") for row in rows], dtype=float)
            assert np.ptp(table[:, 1]) == 0 != table[0, 1]
            assert np.ptp(table[:, 5]) > 5  # the main rotor has started
        believed = 0.4 if first else 0.9
        content = {
            "verdict": "undecided" if first else "effect",
            "causes": [
                {"effects": ["main_input_delay"], "probability": believed},
                {"effects": ["main_actuator_lag"], "probability": 1 - believed},
            ],
            "confusable": [["main_input_delay", "main_actuator_lag"]] if first else [],
            "next_experiment": {"why": "edges", "command": advice} if first else None,
        }
        (out / "diagnosis.json").write_text(json.dumps(content))
        return out

    monkeypatch.setattr(separation, "diagnose_recordings", diagnosed)
    (tmp_path / "separation-1").mkdir()
    (tmp_path / "separation-1" / "recording.csv").touch()
    study = read_study()
    study["separation"]["seeds"] = [1]
    (pair_separation,) = separation.separate(study, tmp_path, lambda words: None)
    assert (pair_separation.why, pair_separation.command) == ("edges", advice)
    assert (pair_separation.before.true, pair_separation.after.true) == (0.4, 0.9)
    assert pair_separation.before.confusable and not pair_separation.after.confusable


def test_the_study_names_what_there_is() -> None:
    study = read_study()
    for name, sizes in study["effects"].items():
        rig_of(name, sizes, 1, study["scatter"])
    assert {"nominal", "diagnosed", "true"} <= set(study["models"])
