"""What a PID law is told beforehand: the curve of a rotor, the inverse of an axis, the coupling."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.pid import Pid, _guided
from trms_cli.controllers.pid_feed_forward import (
    INVERTED,
    PiecewiseLinear,
    decoupling,
    holding_torques,
    inverse,
    rotor_lag,
    rotor_tables,
    torque_curve,
)
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.steady_state import SteadyState

MODEL = Newtonian()


@pytest.fixture(scope="module")
def steady() -> SteadyState:
    return SteadyState(MODEL)


def test_a_table_is_linear_between_its_points_and_ends_with_them() -> None:
    table = PiecewiseLinear([0.0, 1.0, 3.0], [0.0, 2.0, 4.0])
    assert [table.at(v) for v in (-1.0, 0.5, 2.0, 9.0)] == [0.0, 1.0, 3.0, 4.0]
    assert table.inverse().at(3.0) == 2.0
    assert table.slope(0.5) == 2.0 and table.slope(7.0) == 1.0


@pytest.mark.parametrize(("axis", "channel", "lever"), [("pitch", 0, 0.246), ("yaw", 1, 0.282)])
def test_the_curve_is_the_thrust_of_the_rotor(
    steady: SteadyState, axis: str, channel: int, lever: float
) -> None:
    """Against the rotor's equations: B ω + k_t ω|ω| = kφ (k_u u − kφ ω)/R, F = k_f ω|ω|."""
    curve, p = torque_curve(MODEL, axis, channel, steady), MODEL.parameters
    v = "v" if axis == "pitch" else "h"

    def thrust_and_input(omega: float) -> tuple[float, float]:
        sign = "p" if omega >= 0 else "n"
        friction = p["B_mr" if v == "v" else "B_tr"].value * omega
        drag = p[f"k_t{v}{sign}"].value * omega * abs(omega)
        back = p["kphi"].value * omega
        u = ((friction + drag) * p["R"].value / p["kphi"].value + back) / p[f"k_u{v}"].value
        return lever * p[f"k_f{v}{sign}"].value * omega * abs(omega), u

    pairs = np.array([thrust_and_input(omega) for omega in np.linspace(-400, 400, 4001)])
    free = np.interp(curve.at(0.0), pairs[:, 1], pairs[:, 0])
    for torque in np.linspace(curve.x[1], curve.x[-2], 40).tolist():
        wanted = np.interp(torque + free, pairs[:, 0], pairs[:, 1])
        assert curve.at(torque) == pytest.approx(wanted, abs=0.11)
    assert np.all(np.diff(curve.x) > 0) and np.all(np.diff(curve.y) > 0)
    assert (curve.y[0], curve.y[-1]) == pytest.approx((-2.5, 2.5))


def test_an_axis_is_held_by_the_input_of_its_steady_state(steady: SteadyState) -> None:
    curve = torque_curve(MODEL, "yaw", 1, steady)
    holding = holding_torques(MODEL, "yaw", 1, steady, curve.inverse())
    for angle in (-1.0, -0.25, 0.5, 1.25):
        exact = steady.solve(np.array([0.0, angle])).u[1]
        assert curve.at(holding.at(angle)) == pytest.approx(exact, abs=1e-6)


def test_the_tables_are_kept_by_model(
    steady: SteadyState, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRMS_CACHE", str(tmp_path / "functions"))
    channels = {"pitch": 0, "yaw": 1}
    first = rotor_tables(MODEL, channels, steady)
    monkeypatch.setattr("trms_cli.controllers.pid_feed_forward.torque_curve", None)
    assert rotor_tables(MODEL, channels, steady) == first
    for other in (Newtonian(parameters={"l_cb": 0.25}), Newtonian(currents="dynamic")):
        with pytest.raises(TypeError):  # is computed anew
            rotor_tables(other, channels, steady)


def test_the_inverse_of_a_rotor_before_an_axis_is_exact() -> None:
    s = 1j * INVERTED
    wanted = np.polymul([0.4, 1.0], [0.06, 0.02, 0.1])[::-1]  # (1 + 0.4 s)(0.1 + 0.02 s + 0.06 s²)
    found = inverse([1 / np.polyval(wanted[::-1], s)], INVERTED)
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
    assert rotor_lag(found) == pytest.approx(0.4)


def test_the_coupling_is_undone() -> None:
    s = 1j * INVERTED
    own = 1 / (0.06 * s**2 + 0.02 * s + 0.1)
    cross = own * 0.13 * s / (1 + 0.1 * s)
    assert decoupling([cross], [own], INVERTED, 0.1) == pytest.approx(-0.13)


def test_the_reference_asks_for_no_more_than_the_rotor_has() -> None:
    """A step of 2 rad in yaw: uncut, the filter would ask for 0.6 N m; the rotor has 0.1."""
    axis = Pid().init(ControlSetup(MODEL, 0.02, np.zeros(2))).axes[1]
    followed, torques = zip(*(_guided(axis, 2.0) for _ in range(500)), strict=True)
    assert min(torques) >= axis.least - 1e-12 and max(torques) <= axis.most + 1e-12
    assert max(torques) > 0.9 * axis.most
    assert followed[-1] == pytest.approx(2.0, abs=1e-3)
    assert max(followed) < 2.1
