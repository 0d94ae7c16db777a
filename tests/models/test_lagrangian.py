"""The Lagrangian model: energy, check values, and where it must agree with the Newtonian one."""

import casadi as ca
import numpy as np
import pytest

from trms_cli.core.errors import ModelError
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.rig_bodies import bodies, energies
from trms_cli.models.state_kinds import kinds_of_states
from trms_cli.models.steady_state import SteadyState

from .simulate import rates, simulate, square

#: No friction, no rotor that acts on the beam.
FREE = {"k_oh": 0.0, "k_ov": 0.0, "k_g": 0.0, "k_m": 0.0, "k_t": 0.0, "k_chp": 0.0, "k_chn": 0.0}


@pytest.mark.parametrize("shields", ["rings", "as_printed"])
def test_free_motion_keeps_energy_and_the_momentum_about_the_vertical(shields: str) -> None:
    model = Lagrangian(parameters=FREE, shields=shields)
    c = {p.name: p.value for p in model.parameters}
    rig = energies(bodies(c, shields), c["g"])
    total = ca.Function(
        "E", [rig.angles, rig.rates], [rig.kinetic + rig.potential, (rig.inertia @ rig.rates)[0]]
    )
    start = {"alpha_v": 0.4, "S_v": 1.0, "S_h": 3.0}
    states = simulate(model, lambda t: [0.0, 0.0], 20.0, 0.002, start=start)
    names = ("alpha_h", "alpha_v", "S_h", "S_v")
    assert np.ptp(states["alpha_v"]) > 0.5  # it does move
    points = np.array([states[name] for name in names])[:, ::50]
    found = np.array([[float(v) for v in total(x[:2], x[2:])] for x in points.T])
    for values in found.T:
        assert np.ptp(values) < 1e-9 * np.abs(values).max()


def test_power_of_friction_is_what_the_energy_loses() -> None:
    still = FREE | {"k_oh": 0.0185, "k_ov": 0.006}
    model = Lagrangian(parameters=still)
    c = {p.name: p.value for p in model.parameters}
    rig = energies(bodies(c), c["g"])
    total = ca.Function("E", [rig.angles, rig.rates], [rig.kinetic + rig.potential])
    states = simulate(model, lambda t: [0.0, 0.0], 10.0, 0.001, start={"S_h": 2.0, "alpha_v": 0.3})
    lost = c["k_oh"] * states["S_h"] ** 2 + c["k_ov"] * states["S_v"] ** 2
    work = np.sum((lost[1:] + lost[:-1]) / 2) * 0.001

    def energy(k: int) -> float:
        angles = [states["alpha_h"][k], states["alpha_v"][k]]
        return float(total(angles, [states["S_h"][k], states["S_v"][k]]))

    assert energy(0) - energy(-1) == pytest.approx(work, rel=1e-6)


class TestCheckValues:
    def test_rests_where_gravity_puts_it(self) -> None:
        model = Lagrangian()
        assert model.rest()[5] == pytest.approx(-0.6194, abs=5e-5)
        assert rates(model, model.rest()) == pytest.approx(np.zeros(6), abs=1e-12)

    def test_hovers_as_the_newtonian_model_does(self) -> None:
        # In steady state nothing that the two differ in acts.
        for reference in ([0.0, 0.4], [0.2, 0.5], [-0.3, -0.8]):
            theirs, ours = (
                SteadyState(model).solve(np.array(reference))
                for model in (Newtonian(), Lagrangian())
            )
            assert ours.converged and not ours.projected
            assert ours.u == pytest.approx(theirs.u, abs=1e-7)
            assert ours.x[[0, 3]] == pytest.approx(theirs.x[[0, 3]], rel=1e-7)

    def test_the_thesis_centrifugal_moment_is_a_sixth_to_a_quarter_too_large(self) -> None:
        # Of the same yaw rate, on pitch, apart from gravity.
        def centrifugal(model, alpha: float) -> float:
            x = np.zeros(6)
            x[5] = alpha
            at_rest = rates(model, x)[4]
            x[1] = 1.0
            return rates(model, x)[4] - at_rest

        on_axis = {"h": 0.0, "k_g": 0.0}
        for shields in ("rings", "as_printed"):
            ours = Lagrangian(parameters=on_axis, shields=shields)
            excess = centrifugal(Newtonian(), 0.3) / centrifugal(ours, 0.3)
            assert 1.16 < excess < 1.25


class TestAgreement:
    def test_yaw_alone_is_newtonian_to_rounding(self) -> None:
        on_axis = Lagrangian(freedom="horizontal", parameters={"h": 0.0})
        ours, theirs = (
            simulate(model, square(1.2), 30.0)
            for model in (on_axis, Newtonian(freedom="horizontal"))
        )
        assert np.ptp(theirs["alpha_h"]) > 1.0
        assert np.abs(ours["alpha_h"] - theirs["alpha_h"]).max() < 1e-12

    def test_pitch_alone_is_newtonian_to_rounding_without_the_tail_shields_ring(self) -> None:
        thin = {"r_ts": 0.0}
        start = {"alpha_v": -0.5}
        ours, theirs = (
            simulate(kind(freedom="vertical", parameters=thin), square(1.0), 30.0, start=start)
            for kind in (Lagrangian, Newtonian)
        )
        assert np.ptp(theirs["alpha_v"]) > 0.5
        assert np.abs(ours["alpha_v"] - theirs["alpha_v"]).max() < 1e-12
        with_ring = simulate(Lagrangian(freedom="vertical"), square(1.0), 30.0, start=start)
        assert np.abs(with_ring["alpha_v"] - theirs["alpha_v"]).max() > 1e-3

    def test_pitch_with_yaw_free_but_undisturbed_is_newtonian_to_rounding(self) -> None:
        same = {"r_ts": 0.0, "k_m": 0.0}
        ours, theirs = (
            simulate(model, square(1.0, 0.0), 20.0, start={"alpha_v": -0.5})
            for model in (Lagrangian(parameters=same | {"h": 0.0}), Newtonian(parameters=same))
        )
        assert np.abs(ours["alpha_v"] - theirs["alpha_v"]).max() < 1e-12
        assert np.abs(ours["alpha_h"]).max() == 0.0

    def test_a_rotor_that_speeds_up_turns_the_beam_as_in_the_newtonian_model(self) -> None:
        # S has the same meaning: the rates less what the rotors' momenta give.
        model, theirs = Lagrangian(parameters={"h": 0.0}), Newtonian()
        x = np.array([120.0, 0.3, 0.1, 180.0, -0.2, 0.0])
        assert rates(model, x)[[2, 5]] == pytest.approx(
            # J_v has the tail shield's ring.
            rates(theirs, x)[[2, 5]],
            abs=1e-3,
        )
        thin = {"r_ts": 0.0}
        model = Lagrangian(parameters=thin | {"h": 0.0})
        theirs = Newtonian(parameters=thin)
        assert rates(model, x)[[2, 5]] == pytest.approx(rates(theirs, x)[[2, 5]], rel=1e-12)


class TestForm:
    def test_nothing_depends_on_the_yaw_but_the_cable(self) -> None:
        model = Lagrangian(parameters={"k_chp": 0.0, "k_chn": 0.0})
        x = np.array([80.0, 0.5, 0.0, 150.0, 0.4, -0.2])
        turned = x.copy()
        turned[2] = 1.3
        assert rates(model, turned) == pytest.approx(rates(model, x), rel=1e-12)

    def test_the_momenta_stand_for_the_rotors_accelerations(self) -> None:
        # M q̈ + C q̇ + G = τ + K ω̇, with q̈ by differentiating q̇ = S + M⁻¹ K ω along the motion.
        model = Lagrangian()
        at = model.symbols()
        f = model.dynamics(*at)
        second = ca.jtimes(f[[2, 5]], at[0], f)
        evaluate = ca.Function("a", list(at), [f, second, *model.quantities(*at[:3]).values()])
        names = list(model.quantities(*at[:3]))
        x, u = [90.0, 0.4, 0.2, 150.0, -0.3, -0.25], [1.4, 0.7]
        found = evaluate(x, u, model.parameters.values, np.zeros(4))
        slope, acceleration = np.array(found[0]).ravel(), np.array(found[1]).ravel()
        known = {name: float(v) for name, v in zip(names, found[2:], strict=True)}
        c = {p.name: p.value for p in model.parameters}
        rig = energies(bodies(c), c["g"])
        inertia = rig.inertia
        parts = ca.Function(
            "p", [rig.angles, rig.rates], [inertia, rig.coriolis(inertia), rig.gravity]
        )
        v, cosine = slope[[2, 5]], np.cos(x[5])
        m, coriolis, gravity = (np.array(part) for part in parts([x[2], x[5]], v))
        torque = np.array(
            [
                c["l_t"] * known["thrust_tail"] * cosine - c["k_oh"] * v[0] - c["k_chp"] * x[2],
                c["l_m"] * known["thrust_main"]
                - c["k_ov"] * v[1]
                + c["k_g"] * known["thrust_main"] * v[0] * cosine,
            ]
        )
        turning = np.array([c["k_m"] * slope[3] * cosine, c["k_t"] * slope[0]])
        left = m @ acceleration + coriolis @ v + gravity.ravel()
        assert left == pytest.approx(torque + turning, rel=1e-9)

    def test_names_are_those_of_the_newtonian_model(self) -> None:
        ours, theirs = Lagrangian(), Newtonian()
        for attribute in ("states", "inputs", "outputs", "disturbances", "axes", "rotors", "stops"):
            assert getattr(ours, attribute) == getattr(theirs, attribute)
        assert kinds_of_states(ours) == kinds_of_states(theirs)
        at = ours.symbols()[:3]
        assert set(ours.quantities(*at)) == set(theirs.quantities(*theirs.symbols()[:3]))
        assert set(ours.parameters.names) - set(theirs.parameters.names) == {"h"}

    def test_driven_by_measured_speeds_it_needs_no_motors(self) -> None:
        # S is free of the rotors' accelerations: the beam can be fitted without the motors.
        driven = DrivenModel(Lagrangian(), ("omega_v", "omega_h"))
        x, u, p, w = driven.symbols()
        slopes = ca.jacobian(driven.dynamics(x, u, p, w), ca.vertcat(u[:2], w[2:]))
        assert slopes.nnz() == 0

    def test_a_set_without_the_arm_is_told(self, tmp_path) -> None:
        from trms_cli.core.resources import config_folder

        text = (config_folder() / "parameters" / "bench.yaml").read_text(encoding="utf-8")
        without = "\n".join(line for line in text.splitlines() if not line.startswith("  h:"))
        file = tmp_path / "old.yaml"
        file.write_text(without, encoding="utf-8")
        with pytest.raises(ModelError, match="has no h"):
            Lagrangian(parameter_set=str(file))
        Newtonian(parameter_set=str(file))
