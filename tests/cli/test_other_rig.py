"""A rig whose signals have other names than a twin rotor's, from its recording to its figures."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow  # each fits or simulates an unstable rig

EXAMPLES = Path(__file__).parents[2] / "examples"
#: Mass of the cart and of the bob, length, frictions of cart and joint, gravity.
TRUE = {"M": 0.83, "m": 0.145, "l": 0.31, "c": 1.8, "b": 0.0025, "g": 9.81}


def recorded(path: Path, seconds: float = 25.0) -> None:
    """A cart-pole under state feedback and a square wave, by an integrator of its own.

    Signals have other names and units than the model's; encoders show whole steps.
    """
    M, m, length, c, b, g = TRUE.values()
    gains = np.array([-12.9, -12.2, -48.2, -8.3])

    def slope(x: np.ndarray, force: float) -> np.ndarray:
        _, v, angle, rate = x
        coupling = m * length * np.cos(angle)
        push = force - c * v + m * length * np.sin(angle) * rate**2
        twist = m * g * length * np.sin(angle) - b * rate
        inertia = (M + m) * m * length**2 - coupling**2
        acceleration = (m * length**2 * push - coupling * twist) / inertia
        return np.array([v, acceleration, rate, ((M + m) * twist - coupling * push) / inertia])

    x, step, rows = np.array([0.0, 0.0, 0.03, 0.0]), 0.01, ["time[s],f[N],q[mm],theta[deg],mode"]
    for k in range(round(seconds / step)):
        goal = np.array([0.1 * np.sign(np.sin(0.63 * k * step)), 0, 0, 0])
        force = float(-gains @ (x - goal) + np.sign(np.sin(10.7 * k * step + 1)))
        q, theta = 0.05 * np.round(20e3 * x[0]), np.degrees(1.5e-3 * np.round(x[2] / 1.5e-3))
        rows.append(f"{k * step:.2f},{force:.9g},{q:.9g},{theta:.9g},auto")
        for _ in range(4):  # Runge and Kutta
            h = step / 4
            k1 = slope(x, force)
            k2 = slope(x + h / 2 * k1, force)
            k3 = slope(x + h / 2 * k2, force)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3, force))
    path.write_text("\n".join(rows) + "\n")


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("rig") / "cart_pole"
    shutil.copytree(EXAMPLES / "cart_pole", folder)
    recorded(folder / "rig.csv")
    return folder


@pytest.fixture
def inside(rig: Path, trms, monkeypatch):
    monkeypatch.setenv("TRMS_ALLOW", "cart_pole")
    return lambda *argv, **keys: trms.func(rig, *argv, **keys)


NAMES = "{t: time, force: f, position: q, angle: theta}"


def test_its_parameters_are_fitted_and_foretell_what_was_recorded(inside, rig):
    inside("identify", "real=rig.csv", f"data.names={NAMES}", "out=fit", "picture=false")
    document = json.loads((rig / "fit/identification.json").read_text())
    assert document["windows"]["length_s"] < 1.0  # upright it falls over
    for name, true in TRUE.items():
        if name != "g":
            assert document["parameters"][name]["value"] == pytest.approx(true, rel=0.1), name
    words = ["real=rig.csv", f"data.names={NAMES}", "out=validation", "page=false"]
    done = inside("validate", "model=fit/model.yaml", *words)
    assert "not used: mode" in done.stdout
    document = json.loads((rig / "validation/validation.json").read_text())
    assert list(document["error"]["angle"]) == ["0.1", "0.5"]
    assert document["left_out_horizons_s"] == [2.0, 10.0]
    assert document["fit_percent"]["position"] > 95


def test_it_is_replayed_scored_and_exported(inside, rig):
    inside("run", "plant=replay", "plant.file=rig.csv", f"plant.names={NAMES}", "out=replay")
    score = json.loads(inside("score", "replay", "--json").stdout)
    assert score["estimate"]["prediction_rmse"]["position"] < 1e-4
    inside("run", "sim.duration=2", "out=run", "picture=false")
    inside("export", "run", "--out", "run.csv")
    text = (rig / "run.csv").read_text()
    assert "# inputs: force\n# outputs: position, angle\n" in text
    assert "t[s],force[N],position[m],angle[rad],r_position[m]" in text
    done = inside("import", "run.csv", "--json")
    assert json.loads(done.stdout)["channels"]["position"]["unit"] == "m"
    inside("report", "run", "--out", "run.html")


def test_a_calibration_in_its_folder_of_options_is_taken_by_itself(inside, rig):
    own = rig / "configs/calibration/cart_pole.json"
    own.parent.mkdir()
    own.write_text("{}")
    try:
        done = inside("diagnose", "real=rig.csv", f"data.names={NAMES}", "out=none", code=2)
    finally:
        shutil.rmtree(own.parent)
    assert "calibration/cart_pole.json" in done.said and not (rig / "none").exists()
