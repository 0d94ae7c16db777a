"""The TRAS: its check values, its energy, its rotors from coefficients and from a table."""

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.models.static_curve import read_static_curve, rising_spline
from trms_cli.models.tras import Tras

from .simulate import rates, slopes, travel

RPM = np.pi / 30


@pytest.fixture
def write_table(tmp_path: Path):
    """A measured curve made from a rotor's coefficients, with the scatter of a bench."""

    def write(axis: str, header: str = "u[1],omega[rpm],thrust[N]", scatter: float = 0.0) -> Path:
        c = {p.name: p.value for p in Tras().parameters}
        generator = np.random.default_rng(4)
        rows = [header]
        top = 404.0 if axis == "v" else 792.0
        for omega in np.linspace(-top, top, 81):
            side = "p" if omega >= 0 else "n"
            quadratic = c[f"h2_{axis}{side}"] * abs(omega) + c[f"h3_{axis}"] * omega**2
            u = omega * (c[f"h1_{axis}"] + quadratic)
            thrust = c[f"k_f{axis}{side}"] * omega * abs(omega)
            thrust += scatter * generator.standard_normal()
            speed = omega / RPM if "rpm" in header else omega
            rows.append(f"{u:.8g},{speed:.8g},{thrust:.8g}")
        path = tmp_path / f"static_{axis}.csv"
        path.write_text("\n".join(rows) + "\n", encoding="utf-8")
        return path

    return write


class TestEquations:
    def test_rests_where_gravity_puts_it_and_swings_as_its_constants_say(self):
        model = Tras()
        assert model.rest()[5] == pytest.approx(-np.arctan(0.050 / 0.094))
        assert rates(model, model.rest()) == pytest.approx(np.zeros(6), abs=1e-12)
        pitch = [v for v in np.linalg.eigvals(slopes(model, model.rest())[0]) if v.imag > 1]
        stiffness = np.hypot(0.050, 0.094)  # N m/rad around rest
        assert len(pitch) == 1
        assert abs(pitch[0]) == pytest.approx(np.sqrt(stiffness / 0.03006))
        assert pitch[0].real == pytest.approx(-0.01271 / 0.03006 / 2)

    def test_rotors_accelerate_as_published_and_settle_on_their_curve(self):
        model = Tras()
        started = rates(model, model.rest(), (1.0, -1.0))
        assert started[3] == pytest.approx(6100 * RPM, rel=1e-4)
        assert started[0] == pytest.approx(-37000 * RPM, rel=1e-4)
        # Full command: about 3860 rpm and -7340 rpm on the bench.
        end = travel(model, model.rest(), (1.0, -1.0), 8.0)[-1]
        assert end[3] == pytest.approx(3860 * RPM, rel=0.05)
        assert end[0] == pytest.approx(-7340 * RPM, rel=0.05)

    def test_keeps_energy_without_friction_and_commands(self):
        model = Tras(parameters={"k_ov": 0.0, "k_oh": 0.0})
        x = np.array([0.0, 3.0, 0.1, 0.0, 1.0, 0.4])
        states = travel(model, x, (0.0, 0.0), 5.0, 0.002)
        rate_h, rate_v, alpha = states[:, 1], states[:, 4], states[:, 5]
        yaw_inertia = 0.0268 * np.cos(alpha) ** 2 + (0.03006 - 0.0268) * np.sin(alpha) ** 2
        energy = (
            0.5 * 0.03006 * rate_v**2
            + 0.5 * yaw_inertia * rate_h**2
            + 0.050 * np.sin(alpha)
            - 0.094 * np.cos(alpha)
        )
        assert np.ptp(alpha) > 0.5
        assert energy == pytest.approx(energy[0], abs=1e-8)
        momentum = yaw_inertia * rate_h
        assert momentum == pytest.approx(momentum[0], abs=1e-8)

    def test_disturbances_are_torques_and_a_command_acts_on_the_other_axis_with_its_sign(self):
        model = Tras()
        x = model.rest()
        inertia_yaw = 0.0268 * np.cos(x[5]) ** 2 + (0.03006 - 0.0268) * np.sin(x[5]) ** 2
        pushed = rates(model, x, w=[0.01, 0.02, 1e-3, 2e-3])
        expected = [2e-3 / 3.217e-5, 0.02 / inertia_yaw, 0, 1e-3 / 1.7249e-4, 0.01 / 0.03006, 0]
        assert pushed == pytest.approx(expected)
        x = np.zeros(6)
        level = rates(model, x)
        assert rates(model, x, (1.0, 0.0))[1] - level[1] == pytest.approx(-0.0178 / 0.0268)
        assert rates(model, x, (0.0, 1.0))[4] - level[4] == pytest.approx(0.0042 / 0.03006)


class TestMeasuredCurves:
    def test_a_table_gives_the_model_of_its_coefficients_and_takes_their_place(self, write_table):
        measured = Tras(main_curve=str(write_table("v")), tail_curve=str(write_table("h")))
        x = measured.rest()
        u = (0.7, -0.4)
        ours = travel(measured, x, u, 3.0)
        theirs = travel(Tras(), x, u, 3.0)
        assert ours[:, [0, 3]] == pytest.approx(theirs[:, [0, 3]], abs=1.0)
        assert ours[:, [2, 5]] == pytest.approx(theirs[:, [2, 5]], abs=5e-3)
        model = Tras(main_curve=str(write_table("v")))
        assert "k_fvp" not in model.parameters and "h1_v" not in model.parameters
        assert "k_fhp" in model.parameters and "c_fv" in model.parameters
        with pytest.raises(ConfigurationError, match="k_fvp"):
            Tras(main_curve=str(write_table("v")), parameters={"k_fvp": 1e-5})

    def test_speeds_may_be_in_either_unit(self, write_table):
        in_rpm = read_static_curve(str(write_table("v")), "key")
        in_si = read_static_curve(str(write_table("v", "u[1],omega[rad/s],thrust[N]")), "key")
        assert in_si.speed == pytest.approx(in_rpm.speed, rel=1e-6)

    def test_scatter_does_not_become_slope(self, write_table):
        curve = read_static_curve(str(write_table("h", scatter=0.004)), "key")
        spline = rising_spline(curve.speed, curve.thrust)
        assert spline is not None
        x = ca.SX.sym("x")
        f = ca.Function("f", [x], [spline(x), ca.gradient(spline(x), x)])
        at = np.linspace(-1200.0, 1200.0, 4001).reshape(1, -1)
        values, slopes = (np.array(v).ravel() for v in f.map(4001)(at))
        assert np.all(slopes > 0)  # beyond the table too
        assert np.gradient(values, at.ravel())[1:-1] == pytest.approx(slopes[1:-1], abs=5e-6)
        assert (
            np.sqrt(np.mean((np.interp(curve.speed, at.ravel(), values) - curve.thrust) ** 2))
            < 0.006
        )

    @pytest.mark.parametrize(
        ("content", "words"),
        [
            ("", "empty"),
            ("u[1],omega[rpm]\n0,0\n", "lacks a column"),
            ("u[V],omega[rpm],thrust[N]\n0,0,0\n", "u\\[V\\]"),
            ("u[1],omega[rpm],thrust[N]\n0,0,0\n0.1,400,0.1\n", "2 points"),
            ("u[1],omega[rpm],thrust[N]\n" + "0,zero,0\n" * 9, "no row of 3 numbers"),
            (
                "u[1],omega[rpm],thrust[N]\n"
                + "".join(f"{k / 10},{400 * min(k, 5)},{k}\n" for k in range(10)),
                "does not rise with the command",
            ),
            (
                "u[1],omega[rpm],thrust[N]\n"
                + "".join(f"{k / 10},{400 * k},{-k}\n" for k in range(10)),
                "thrust does not rise",
            ),
        ],
    )
    def test_a_wrong_table_is_explained(self, tmp_path, content, words):
        path = tmp_path / "curve.csv"
        path.write_text(content, encoding="utf-8")
        with pytest.raises(ModelError, match=words) as caught:
            Tras(main_curve=str(path))
        assert caught.value.remedy

    def test_a_missing_table_is_named(self, tmp_path):
        with pytest.raises(ModelError, match=r"nowhere\.csv") as caught:
            Tras(tail_curve=str(tmp_path / "nowhere.csv"))
        assert caught.value.where == "model.tail_curve"
