"""The white-box models as a person runs them: control, estimation, effects, what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from trms_cli.cli import main

#: Pitches that the maker's tail rotor can hold against the main rotor's reaction.
LOW = ["ref.alpha_v.offset=-0.45", "ref.alpha_v.amplitude=0.15"]
AT_LOW = "{alpha_v: -0.45, alpha_h: 0.0}"


def scored(folder: Path, *words: str, duration: float = 20.0) -> dict[str, float]:
    """Mean errors by channel."""
    out = folder / "run"
    given = ["run", *words, f"sim.duration={duration}", "picture=false", f"out={out}"]
    assert main(given) == 0
    score = json.loads((out / "score.json").read_text(encoding="utf-8"))
    assert not score["solver"]["failures"]
    return {name: channel["rmse"] for name, channel in score["channels"].items()}


@pytest.mark.parametrize(
    ("words", "most"),
    [
        (["model=motor_main", "ref=speed", "controller=newton_mpc"], {"omega_v": 25.0}),
        (["model=propeller_tail", "ref=speed", "controller=lqr"], {"omega_h": 45.0}),
    ],
)
def test_a_rotor_alone_follows_speeds(words, most, tmp_path: Path) -> None:
    found = scored(tmp_path, *words)
    assert found.keys() == most.keys()
    for name, value in most.items():
        assert found[name] < value


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "pitch", "yaw"),
    [
        (["model=lagrangian", "controller=newton_mpc"], 0.25, 0.15),
        (["model=lagrangian", "controller=pid", "effect=yaw_coulomb_friction"], 0.27, 0.20),
        (["model=lagrangian", "controller=lqr", "effect=main_input_delay"], 0.25, 0.15),
        (["model=lagrangian_full", "controller=pid"], 0.27, 0.20),
        (["model=tastemirov", "controller=newton_mpc"], 0.32, 0.15),
        (["model=feedback_manual", *LOW], 0.09, 0.2),
        (
            ["model=feedback_manual", *LOW, "controller=lqr",
             f"controller.operating_point={AT_LOW}"], 0.09, 0.2,
        ),
        (
            ["model=feedback_manual", *LOW, "controller=pid",
             f"controller.operating_points=[{AT_LOW}]"], 0.16, 0.25,
        ),
        (["model=newtonian", "model@plant.model=lagrangian"], 0.25, 0.15),
    ],
)  # fmt: skip
def test_a_model_is_controlled_and_estimated(words, pitch, yaw, tmp_path: Path) -> None:
    found = scored(tmp_path, *words)
    assert found["alpha_v"] < pitch and found["alpha_h"] < yaw


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["model=motor_main"], ["ref.omega_v", "ref=speed"]),
        (["model=motor_main", "ref=speed", "controller=pid"], ["no axis", "newton_mpc or lqr"]),
        (["model=motor_tail", "ref=speed", "effect=yaw_coulomb_friction"], ["no yaw axis"]),
        (["model=lagrangian", "model.parameter_set=tras"], ["belongs to model 'tras'"]),
        (["model=lagrangian", "model.shields=round"], ["model.shields", "rings"]),
        (["model=newtonian", "model.main_interface=no.csv"], ["model.main_interface", "u[V],v[V]"]),
        (["model=motor_main", "ref=speed", "model.voltage_limit=0"], ["model.voltage_limit"]),
        (
            ["model=feedback_manual", "model@plant.model=newtonian"],
            ["measures omega_v, omega_h", "plant.sensors.channels=[alpha_v,alpha_h]"],
        ),
        (["model=feedback_manual", "controller=lqr"], ["cannot rest", "alpha_v=-0.156"]),
    ],
)
def test_what_makes_no_sense_is_told(words, told, capsys, tmp_path: Path) -> None:
    assert main(["run", *words, f"out={tmp_path / 'run'}"]) == 2
    # A message is broken into lines where the terminal ends.
    said = " ".join(capsys.readouterr().err.split())
    for part in told:
        assert part in said
    assert not (tmp_path / "run").exists()
