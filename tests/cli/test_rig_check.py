"""``trms rig check``: readings, zero and signs of a rig behind a wire, and the wiring of them."""

import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.yaml_data import load_yaml
from trms_cli.plants.wiring import Wire
from trms_cli.simulation.rig_check import (
    Movement,
    RigCheckRequest,
    corrected_wires,
    remarks_on,
    signs_to_turn,
    wiring_yaml,
)

ALL = ("alpha_v", "alpha_h", "omega_v", "omega_h", "u_v", "u_h")


@pytest.fixture
def served(started: Callable[..., subprocess.Popen[str]]) -> tuple[subprocess.Popen[str], str]:
    """A simulated rig in a process of its own, and the word that names its port."""
    process = started("rig", "serve", "port=0", "duration=120")
    assert process.stdout is not None
    match = re.search(r"plant\.port=\d+", process.stdout.readline())
    assert match is not None
    return process, match[0]


def rest_of(served: tuple[subprocess.Popen[str], str]) -> str:
    """What the rig's computer says of what happened; it is ended."""
    served[0].terminate()
    return served[0].communicate(timeout=20)[0]


def test_without_a_terminal_it_takes_the_present_position_for_rest(trms, served, tmp_path):
    file = "lab/configs/wiring/my_rig.yaml"
    words = ("rest.alpha_h=0.3", "plant.wiring.alpha_h.unit=deg", "plant.wiring.alpha_h.sign=-1")
    done = trms("rig", "check", served[1], "duration=0.4", "every=0.2", "zero=true", *words,
                f"out={file}")  # fmt: skip
    lines = [line for line in done.stdout.splitlines() if re.match(r" +\d\.\d\d s  ", line)]
    assert len(lines) == 2 and all("alpha_v -0.6197 (raw -0.619728)" in line for line in lines)
    text = (tmp_path / file).read_text(encoding="utf-8")
    assert text.startswith("# wiring of plant=udp, by trms rig check; at rest alpha_v -0.62 rad")
    wires = load_yaml(text)
    assert tuple(wires) == ALL and wires["alpha_h"]["sign"] == -1
    # it reads 0 and stands at 0.3 rad: −1 · π/180 · (0 − offset) = 0.3
    assert wires["alpha_h"]["offset"] == pytest.approx(0.3 * 57.29577951)
    assert wires["alpha_v"]["offset"] == pytest.approx(0.62 - 0.61972819, abs=1e-6)
    assert "armed" not in rest_of(served)
    # and it is an option: as it is told to be typed
    typed = re.search(r"trms (run .*)", done.stdout)
    assert typed is not None and served[1] in typed[1]
    composed = trms(*typed[1].split(), "--cfg", "job").stdout
    assert load_yaml(composed)["plant"]["wiring"] == wires


def test_nothing_is_commanded_or_written_that_was_not_asked_for(trms, refused, served, tmp_path):
    trms("rig", "check", served[1], "duration=0.2")
    assert not list(tmp_path.glob("**/*.yaml"))
    words = ("rig", "check", served[1], "duration=0.2")
    refused(*words, "pulse=0.5", words="nobody is at a terminal")
    refused("rig", "check", "plant=simulated", words="plant=simulated is no rig with a wiring")
    refused(*words, "out=my_rig.yaml", words="FOLDER/wiring/NAME.yaml")
    there = tmp_path / "wiring" / "there.yaml"
    there.parent.mkdir()
    there.write_text("# mine\n", encoding="utf-8")
    refused(*words, "out=wiring/there.yaml", words="is there already")
    refused(*words, "pulse=-1", words="expected a number >= 0")
    refused(*words, "rest.gamma=1", words="gamma")
    assert there.read_text(encoding="utf-8") == "# mine\n"
    assert "armed" not in rest_of(served)


@pytest.fixture
def tail(tmp_path: Path) -> list[str]:
    """Words for a wiring of the tail rotor alone, with two signs that are wrong."""
    folder = tmp_path / "lab" / "wiring"
    folder.mkdir(parents=True)
    (folder / "tail.yaml").write_text(
        "# tail rotor alone\nalpha_h: {channel: 1, sign: 1}\n"
        "omega_h: {channel: 3, sign: -1}\nu_h: {channel: 1, sign: -1}\n",
        encoding="utf-8",
    )
    return ["--config-dir", str(tmp_path / "lab"), "wiring@plant.wiring=tail", "duration=0.2"]


def typed(screen: Any, *answers: tuple[str, str]) -> None:
    """Wait for questions, and answer them."""
    for question, answer in answers:
        assert screen.read(60.0, question.encode()), screen.lines
        screen.type(f"{answer}\n".encode())


@pytest.mark.slow
def test_a_person_is_led_through_zero_and_signs(in_terminal, served, tail, tmp_path):
    screen = in_terminal(
        *("rig", "check", served[1], *tail, "pulse=0.6", "out=lab/wiring/turned.yaml"),
        size=(60, 120),
    )
    typed(
        screen,
        ("should this be its zero?", "y"),
        ("alpha_h here, rad [Enter: 0", "0.1"),
        ("tail rotor: 0.6 V for 0.5 s", "y"),
        ("which way did the beam", "cl"),
    )
    assert screen.end(30.0) == 0, screen.lines
    assert any("the signs of u_h, omega_h are turned" in line for line in screen.lines)
    wires = load_yaml((tmp_path / "lab" / "wiring" / "turned.yaml").read_text(encoding="utf-8"))
    assert {name: wire["sign"] for name, wire in wires.items()} == dict.fromkeys(wires, 1)
    assert wires["alpha_h"]["offset"] == pytest.approx(-0.1)
    said = rest_of(served)
    assert said.index("armed") < said.index("disarmed") and "watchdog" not in said


def test_a_person_who_does_not_agree_sees_nothing_move(in_terminal, served, tail):
    screen = in_terminal("rig", "check", served[1], *tail, "pulse=0.6", size=(60, 120))
    typed(screen, ("should this be its zero?", ""), ("tail rotor: 0.6 V", "n"))
    assert screen.end(30.0) == 0
    assert any("u_h was not tried" in line for line in screen.lines)
    assert "armed" not in rest_of(served)


def test_without_its_heartbeat_it_is_not_pulsed(in_terminal, served, tail):
    words = (*tail, "pulse=0.6", "plant.envelope.heartbeat.port=0")
    screen = in_terminal("rig", "check", served[1], *words, size=(60, 120))
    typed(screen, ("should this be its zero?", ""), ("tail rotor: 0.6 V", "y"))
    assert screen.end(30.0) == 2
    assert any("heartbeat" in line for line in screen.lines)
    assert "armed" not in rest_of(served)


@pytest.mark.slow
def test_ctrl_c_amid_a_pulse_lands_the_rig(in_terminal, served, tail):
    words = ("rig", "check", served[1], *tail, "pulse=0.6", "pulse_time=30")
    screen = in_terminal(*words, size=(60, 120))
    typed(screen, ("should this be its zero?", ""), ("tail rotor: 0.6 V", "y"))
    assert served[0].stdout is not None
    while "  armed" not in served[0].stdout.readline():
        pass
    screen.type(b"\x03")
    assert screen.end(30.0) == 130, screen.lines
    assert any("landing the rig" in line for line in screen.lines)
    said = rest_of(served)
    assert "disarmed" in said and "u_h 0 V" in said and "watchdog" not in said


def moved(**changes: float) -> list[Movement]:
    return [
        Movement(name, change, 0.001, 0.005 if name.startswith("alpha") else 5.0)
        for name, change in changes.items()
    ]


@pytest.mark.parametrize(
    ("direction", "angle", "speed", "turned"),
    [
        (1, 0.1, 40.0, ()),
        (1, -0.1, 40.0, ("alpha_v",)),
        (1, 0.1, -40.0, ("omega_v",)),
        (-1, -0.1, -40.0, ("u_v",)),
        (-1, 0.1, -40.0, ("u_v", "alpha_v")),
        (-1, 0.1, 40.0, ("u_v", "alpha_v", "omega_v")),
        (1, 0.004, -40.0, ("omega_v",)),  # the angle did not move enough to say
        (-1, 0.004, -4.0, ("u_v",)),
    ],
)
def test_signs_follow_from_what_the_person_saw(direction, angle, speed, turned):
    movements = moved(alpha_v=angle, omega_v=speed, alpha_h=0.2, omega_h=0.0)
    assert signs_to_turn("u_v", direction, movements) == turned


def test_what_is_strange_about_a_movement_is_told():
    assert remarks_on("u_v", moved(alpha_v=0.1, omega_v=40.0, omega_h=3.0)) == []
    (still,) = remarks_on("u_v", moved(alpha_v=0.001, omega_v=40.0))
    assert "alpha_v did not move" in still
    exchanged = remarks_on("u_v", moved(alpha_v=0.1, omega_v=0.0, omega_h=-80.0))
    assert "exchanged" in exchanged[0]


def test_a_corrected_wiring_reads_the_rest_and_comes_back_from_its_yaml():
    wires = {
        "alpha_v": Wire(channel="pitch", sign=1, unit="deg", scale=0.5, offset=3.0),
        "omega_v": Wire(channel="speed", sign=1, table=((0.0, 0.0), (1.0, 30.0))),
        "u_v": Wire(channel="duty", sign=1, limit=(-2.0, 2.0)),
    }
    new = corrected_wires(wires, ["alpha_v", "u_v"], {"alpha_v": -0.62}, {"alpha_v": 812.0})
    assert (new["alpha_v"].sign, new["u_v"].sign, new["omega_v"]) == (-1, -1, wires["omega_v"])
    value = -1 * 0.017453292519943295 * 0.5 * (812.0 - new["alpha_v"].offset)
    assert value == pytest.approx(-0.62)
    back = load_yaml(wiring_yaml(new, "a wiring of mine"))
    for name, wire in new.items():
        for key, written in back[name].items():
            if isinstance(written, list):
                written = tuple(tuple(x) if isinstance(x, list) else x for x in written)
            expected = getattr(wire, key)
            assert written == (pytest.approx(expected) if key == "offset" else expected), (
                name,
                key,
            )
    with pytest.raises(ConfigurationError, match="a table has no offset"):
        corrected_wires(wires, [], {"omega_v": 0.0}, {"omega_v": 0.0})


def test_a_request_that_makes_no_sense_is_refused():
    with pytest.raises(ConfigurationError, match="'omega_v' given"):
        RigCheckRequest(rest={"omega_v": 0.0})
    with pytest.raises(ConfigurationError, match="at least"):
        RigCheckRequest(duration=0.01)
