"""The interface: a gain, a measured curve, where either saturates, and what is refused."""

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.single_rotor import SingleRotor
from trms_cli.models.static_curve import interface_of

from .simulate import rates


def voltage(circuit, u: float, gain: float = 8.5) -> float:
    x = ca.SX.sym("u")
    return float(ca.Function("v", [x], [circuit.voltage(x, {"k_uv": ca.SX(gain)})])(u))


@pytest.fixture
def write(tmp_path: Path):
    def table(u, v, header: str = "u[V],v[V]") -> str:
        path = tmp_path / "interface.csv"
        rows = [f"{a:.9g},{b:.9g}" for a, b in zip(u, v, strict=True)]
        path.write_text("\n".join(["# measured", header, *rows]) + "\n", encoding="utf-8")
        return str(path)

    return table


def test_a_gain_and_its_limits() -> None:
    assert voltage(interface_of("v", None, None, "model.main_"), 2.5) == 21.25
    limited = interface_of("v", None, 15.0, "model.main_")
    assert [voltage(limited, u) for u in (-2.5, -1.0, 2.5)] == [-15.0, -8.5, 15.0]


def test_a_measured_curve_is_followed_between_its_points(write) -> None:
    u = np.linspace(-2.5, 2.5, 41)
    circuit = interface_of("v", write(u, 8.5 * u + 0.3 * u**3), None, "model.main_")
    for at in (-2.3, -0.03, 0.0, 1.111, 2.49):
        assert voltage(circuit, at) == pytest.approx(8.5 * at + 0.3 * at**3, abs=1e-6)


def test_flat_ends_are_saturation_and_open_ends_go_on(write) -> None:
    u = np.linspace(-4.0, 4.0, 81)
    circuit = interface_of("v", write(u, np.clip(8.5 * u, -21.5, 21.5)), None, "model.main_")
    for at in (-9.0, -3.0, 3.0, 9.0):
        assert voltage(circuit, at) == pytest.approx(np.copysign(21.5, at), abs=1e-6)
    assert voltage(circuit, 1.0) == pytest.approx(8.5, abs=0.02)
    open_ended = interface_of("v", write(u, 8.5 * u), None, "model.main_")
    assert voltage(open_ended, 6.0) == pytest.approx(51.0)


def test_units_and_the_limit_apply(write) -> None:
    u = np.linspace(-2500, 2500, 21)
    circuit = interface_of("v", write(u, 8.5e-3 * u, "u[mV],v[V]"), 10.0, "model.main_")
    assert voltage(circuit, 1.0) == pytest.approx(8.5)
    assert voltage(circuit, 2.0) == 10.0


@pytest.mark.parametrize("kind", [Newtonian, Lagrangian])
def test_a_straight_curve_is_the_gain(kind, write) -> None:
    u = np.linspace(-2.5, 2.5, 21)
    table = write(u, 8.5 * u)
    measured, nominal = kind(main_interface=table), kind()
    assert set(nominal.parameters.names) - set(measured.parameters.names) == {"k_uv"}
    x, command = np.array([50.0, 0.1, 0.2, 120.0, 0.1, -0.3]), [1.3, 0.4]

    assert rates(measured, x, command) == pytest.approx(rates(nominal, x, command), rel=1e-9)


def test_mistakes_are_told_with_their_place(write, tmp_path) -> None:
    u = np.linspace(-2.5, 2.5, 21)
    with pytest.raises(ConfigurationError) as raised:
        Newtonian(tail_voltage_limit=0.0)
    assert raised.value.where == "model.tail_voltage_limit"
    with pytest.raises(ConfigurationError) as raised:
        SingleRotor(rotor="main", voltage_limit=-1.0)
    assert raised.value.where == "model.voltage_limit"
    with pytest.raises(ModelError, match="cannot read") as missing:
        Newtonian(main_interface=str(tmp_path / "none.csv"))
    assert missing.value.where == "model.main_interface"
    for problem, table in {
        "does not rise": (u, -8.5 * u),
        "stands twice": (np.append(u, 2.5), np.append(8.5 * u, 21.0)),
        "3 points": ([-1, 0, 1], [-8, 0, 8]),
        "not part of an interface curve": (u, 8.5 * u, "u[V],i[A]"),
    }.items():
        with pytest.raises(ModelError, match=problem):
            Newtonian(main_interface=write(*table))
