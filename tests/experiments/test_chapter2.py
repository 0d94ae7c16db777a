"""The study of chapter 2: what it reads, what its parts claim, and that its page is its own."""

import json
import re
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from experiments.chapter2.__main__ import PAGE
from experiments.chapter2.agreement import study_agreement
from experiments.chapter2.axes import ANGLES, one_axis, pair_of_commands, two_axes
from experiments.chapter2.bench_tests import study_bench_tests
from experiments.chapter2.bridge import TERMS, Bridge
from experiments.chapter2.drawing import PITCH, YAW, attitude
from experiments.chapter2.friction import (
    AXES,
    PROFILES,
    break_away_torque,
    friction_torques,
    profiled_model,
    study_friction,
)
from experiments.chapter2.interface import study_interface
from experiments.chapter2.page import moves, signals_of
from experiments.chapter2.paths import PAIRS, study_paths
from experiments.chapter2.rotors import study_rotor
from experiments.chapter2.simulation import difference
from experiments.chapter2.study import HERE, signal
from experiments.page_tables import write_tables
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.newtonian import Newtonian, geometry
from trms_cli.models.operating_point import at_command


def rates(model) -> np.ndarray:
    at = model.symbols()
    f = ca.Function("f", list(at), [model.dynamics(*at)])
    x, u = (90.0, 0.5, 0.2, 170.0, -0.4, -0.3), [1.2, 0.5]
    return np.array(f(x, u, model.parameters.values, np.zeros(4))).ravel()


class TestStudy:
    def test_cases_of_one_axis_are_those_of_the_page(self, study, expected):
        for axis, shapes in study.one_axis.items():
            cases = [(shape, *case) for shape, of in shapes.items() for case in of]
            case_names = [f"{shape} {hertz:g} Hz, {volts:g} V" for shape, hertz, volts in cases]
            assert case_names == list(expected["one_axis"][axis])

    def test_nine_pairs_stay_within_what_the_motors_take(self, study):
        assert len(study.two_axes) == 9
        reasons = set()
        for name, pair in study.two_axes.items():
            u = pair_of_commands(study, name)
            assert u.shape == (round(pair.duration / study.sample_time), 2)
            assert np.abs(u).max() <= 2.5
            assert pair.why not in reasons
            reasons.add(pair.why)

    def test_an_unknown_signal_or_key_is_told(self):
        with pytest.raises(ConfigurationError, match="no signal 'sin'"):
            signal({"signal": "sin"}, "case.u_v")
        with pytest.raises(ConfigurationError, match="amplitud"):
            signal({"signal": "sine", "amplitud": 1.0}, "case.u_v")


def test_a_difference_is_measured_as_said():
    t = np.linspace(0, 1, 1001)
    measure = np.sin(2 * np.pi * t)
    d = difference(measure + 0.1, measure)
    assert (d.rms, d.largest) == (pytest.approx(0.1), pytest.approx(0.1))
    assert d.fit == pytest.approx(100 * (1 - 0.1 / np.std(measure)), rel=1e-9)
    assert np.isnan(difference(measure, np.zeros(1001)).fit)


def test_the_bridge_leads_from_the_newtonian_to_the_lagrangian_model_and_each_term_matters():
    whole = rates(Bridge(TERMS))
    assert rates(Bridge(())) == pytest.approx(rates(Newtonian()), rel=1e-12)
    assert whole == pytest.approx(rates(Lagrangian(parameters={"h": 0.0})), rel=1e-10)
    for term in TERMS:
        without = rates(Bridge(tuple(t for t in TERMS if t != term)))
        assert np.abs(without - whole).max() > 1e-3, term


class TestDrawing:
    """Angles, arms and signs of the drawing are those of the equations."""

    @pytest.fixture(params=[(PITCH, 0.0), (0.0, YAW), (-0.4, -0.8)])
    def rig(self, request):
        return attitude(*request.param)

    @staticmethod
    def moment(rig, axis, point, force) -> float:
        """Of a force about an axis of the drawing; positive as its angle."""
        if axis == "yaw":
            return float(np.cross(point, force)[2])
        # a positive pitch turns about −η
        return float(-rig.rotation[:, 1] @ np.cross(point - rig.pivot, force))

    @staticmethod
    def quantities(model, rig, omega):
        x = np.zeros(model.n_x)
        for name, value in {"alpha_v": rig.alpha_v, "alpha_h": rig.alpha_h, **omega}.items():
            x[model.state_index(name)] = value
        at = model.symbols()[:3]
        named = model.quantities(*at)
        f = ca.Function("q", list(at), list(named.values()))
        values = f(x, np.zeros(model.n_u), model.parameters.values)
        return x, dict(zip(named, map(float, values), strict=True))

    def test_weights_have_the_moment_of_gravity(self, rig):
        _, quantity = self.quantities(Newtonian(), rig, {})
        g = rig.parameters["g"]
        moment = sum(
            self.moment(rig, "pitch", centre, np.array([0.0, 0.0, -body.mass * g]))
            for body, centre in rig.masses.values()
        )
        assert moment == pytest.approx(quantity["gravity_moment"], rel=1e-12)

    def test_positive_commands_push_where_the_thrusts_are_drawn(self, rig):
        model = Newtonian()
        x, quantity = self.quantities(model, rig, {"omega_v": 150.0, "omega_h": 250.0})
        at = model.symbols()
        f = ca.Function("f", list(at), [model.dynamics(*at)])

        def accelerations(x):
            rates = np.array(
                f(x, np.zeros(2), model.parameters.replaced({"k_g": 0.0}).values, [0] * 4)
            ).ravel()
            return {name: rates[model.state_index(name)] for name in ("S_v", "S_h")}

        idle = x.copy()
        for name in ("omega_v", "omega_h"):
            idle[model.state_index(name)] = 0.0
        # the momenta of the rotors move the angles: what thrust does is in S at equal rates
        turning, still = accelerations(x), accelerations(idle)
        c = rig.parameters
        for command, axis, letter, thrust in (
            ("u_v", "pitch", "v", "thrust_main"),
            ("u_h", "yaw", "h", "thrust_tail"),
        ):
            force = rig.thrusts[command]
            drawn = self.moment(rig, axis, force.point, quantity[thrust] * force.direction)
            inertia = quantity[f"inertia_{axis}"]
            rate = (
                c["k_t"] * 250.0 / quantity["inertia_pitch"]
                if letter == "v"
                else c["k_m"] * 150.0 * np.cos(rig.alpha_v) / quantity["inertia_yaw"]
            )
            friction = c[f"k_o{letter}"] * rate
            centrifugal = 0.0
            if letter == "v":
                yaw_rate = c["k_m"] * 150.0 * np.cos(rig.alpha_v) / quantity["inertia_yaw"]
                H = geometry(c)["H"]
                centrifugal = 0.5 * H * yaw_rate**2 * np.sin(2 * rig.alpha_v)
            gained = inertia * (turning[f"S_{letter}"] - still[f"S_{letter}"])
            assert drawn > 0
            assert drawn == pytest.approx(gained + friction + centrifugal, rel=1e-9)

    def test_a_rotor_that_spins_up_turns_the_beam_the_other_way(self, rig):
        """The arcs of ω: both rotors are drawn clockwise, as seen in their views."""
        model, c = Newtonian(), rig.parameters
        x, quantity = self.quantities(model, rig, {"omega_v": 150.0, "omega_h": 250.0})
        at = model.symbols()
        f = ca.Function("f", list(at), [model.dynamics(*at)])
        rates = np.array(f(x, np.zeros(2), model.parameters.values, [0] * 4)).ravel()
        # with S = 0 the beam has the momentum that the rotors lack: theirs is −k ω
        upright = rig.rotation[:, 2]
        beam_yaw = rates[model.state_index("alpha_h")] * quantity["inertia_yaw"]
        rotor = -c["k_m"] * 150.0 * upright  # clockwise from above with the beam level
        assert beam_yaw + rotor[2] == pytest.approx(0.0, abs=1e-15)
        beam_pitch = rates[model.state_index("alpha_v")] * quantity["inertia_pitch"]
        across = rig.rotation[:, 1]
        rotor = c["k_t"] * 250.0 * across  # clockwise for who looks along the pitch axis
        assert beam_pitch + -across @ rotor == pytest.approx(0.0, abs=1e-15)


class TestFriction:
    @pytest.mark.parametrize("freedom", AXES)
    def test_profiles_are_the_law_of_the_effect(self, freedom):
        axis, letter = AXES[freedom]
        rates = np.array([-0.2, -0.02, 0.0, 0.02, 0.2])
        for profile in PROFILES:
            model = profiled_model(freedom, profile)
            viscous, dry = friction_torques(model, axis, rates)
            k, effect = model.parameters[f"k_o{letter}"].value, f"{axis}_stribeck_friction"
            F, e, v = (
                model.parameters[f"{effect}.{n}"].value for n in ("torque", "excess", "velocity")
            )
            assert viscous == pytest.approx(-k * rates, rel=1e-9, abs=1e-15)
            law = -np.sign(rates) * F * (1 + e * np.exp(-((rates / v) ** 2)))
            assert dry == pytest.approx(law, rel=2e-4, abs=1e-9)
            assert break_away_torque(model, axis) == pytest.approx(F * (1 + e), abs=1e-6)

    def test_a_whole_profile_is_a_model_of_any_command(self, tmp_path):
        from trms_cli.cli import main as trms

        words = [f"model={HERE / 'friction_vertical.yaml'}", "controller=open_loop"]
        assert trms(["run", *words, "sim.duration=1", "picture=false", f"out={tmp_path}"]) == 0

    def test_figures(self, study, expected):
        for freedom in AXES:
            rig, figures = study_friction(study, freedom), expected["friction"][freedom]
            assert np.isnan(rig.rests["viscous"]) and figures["rests_s"]["viscous"] is None
            assert rig.rests["stiction"] < rig.rests["Coulomb"] < 20.0
            for profile in PROFILES[1:]:
                assert rig.rests[profile] == pytest.approx(figures["rests_s"][profile], abs=0.1)
                assert rig.offsets[profile] == pytest.approx(
                    figures["offset_rad"][profile], rel=1e-3
                )
                # held: what pulls back there is less than what breaks away
                stiffness = {"vertical": 0.2646, "horizontal": 0.0158}[freedom]
                assert stiffness * abs(rig.offsets[profile]) < rig.break_away[profile]


def test_interfaces_saturate_beyond_the_commands(study, expected):
    for rotor in ("main", "tail"):
        circuit = study_interface(study, rotor)
        reached = np.abs(circuit.commands) > circuit.saturates_at
        assert np.abs(circuit.limited[reached]) == pytest.approx(circuit.limit)
        assert circuit.limited[~reached] == pytest.approx(circuit.gain * circuit.commands[~reached])
        assert 2.5 < circuit.saturates_at < 2.6
        # two standard deviations more gain, and the limit is met within the rig's commands
        assert circuit.saturates_at / 1.06 < 2.5
        assert circuit.currents[-1] == pytest.approx(
            expected["interface"][rotor]["current_A"], rel=1e-4
        )


class TestSignals:
    def test_nine_pairs_of_commands(self, study, expected):
        recorded = expected["signals"]
        signals = signals_of(study)
        assert len(signals) == 9
        for name, channels in signals.items():
            for c in channels:
                if not moves(c):
                    assert f"{name} {c.name}" not in recorded
                    continue
                figures = recorded[f"{name} {c.name}"]
                assert (c.mean, c.sd) == pytest.approx((figures["mean"], figures["sd"]), abs=1e-5)
                assert c.peak_frequency == pytest.approx(figures["peak_Hz"], rel=1e-4)
        # a sine and a square of 0.05 Hz say so
        assert (
            recorded["level_yaw u_h"]["peak_Hz"] == recorded["main_square u_v"]["peak_Hz"] == 0.05
        )

    def test_nine_pairs_are_those_of_the_linear_model(self, study, expected):
        """The multisines see the slope of the equations, hold included, and what is recorded."""
        from scipy.signal import cont2discrete

        model = Newtonian()
        point = at_command(model, np.array([1.2, 0.5]))
        x, u, p, w = model.symbols()
        f = model.dynamics(x, u, p, w)
        slopes = ca.Function("s", [x, u, p, w], [ca.jacobian(f, x), ca.jacobian(f, u)])
        A, B = (np.array(m) for m in slopes(point.x, point.u, model.parameters.values, [0] * 4))
        hold = study.paths.hold
        A, B, *_ = cont2discrete((A, B, np.eye(6), np.zeros((6, 2))), hold)
        paths = study_paths(study)
        assert [(path.source, path.target) for path in paths] == [pair[:2] for pair in PAIRS]
        for path, (source, target, command) in zip(paths, PAIRS, strict=True):
            z = np.exp(2j * np.pi * path.frequency * hold)
            column = B[:, ["u_v", "u_h"].index(command)]
            linear = np.array([np.linalg.solve(each * np.eye(6) - A, column) for each in z])
            response = linear[:, model.state_index(target)]
            if source != command:
                response = response / linear[:, model.state_index(source)]
            assert np.abs(path.response - response).max() < 0.03 * path.peak
            figures = expected["paths"][f"{source} {target}"]
            assert path.static_gain == pytest.approx(figures["static_gain"], rel=1e-3)
            assert path.mean_coherence(path.coherence_large) == pytest.approx(
                figures["coherence_large"], rel=1e-3
            )
            assert path.coherence_large.mean() < path.coherence.mean() <= 1.0

    def test_what_the_prose_claims_of_them(self, expected):
        pairs = expected["paths"]
        assert {name for name, pair in pairs.items() if pair["delay_s"] is None} == {
            "u_v alpha_h",
            "u_h alpha_v",
            "omega_v alpha_h",
        }
        assert pairs["u_h alpha_v"]["coherence_large"] < 0.92
        assert min(pair["coherence"] for pair in pairs.values()) > 0.99
        assert pairs["u_v alpha_v"]["peak_Hz"] == pytest.approx(0.3, abs=0.02)


class TestExpectation:
    def test_rotors(self, study, expected):
        small = study_rotor(study, "tail")
        for size, rise in small.rises.items():
            assert rise == pytest.approx(expected["rotors"]["h"]["rise_s"][str(size)], rel=1e-4)
        for frequency, gain in small.gains.items():
            assert gain == pytest.approx(expected["rotors"]["h"]["gain"][str(frequency)], rel=1e-4)
        # The armature's inductance cannot be seen beside a tachometer's noise of 1.6 rad/s.
        assert small.current_effect < 0.2

    def test_yaw_alone(self, study, expected):
        for case in one_axis(study, "horizontal"):
            expected_difference = expected["one_axis"]["horizontal"][case.name]["alpha_h"]
            yaw_difference = case.differences["alpha_h"]
            assert yaw_difference.rms == pytest.approx(expected_difference["rms_rad"], rel=1e-3)
            assert yaw_difference.fit == pytest.approx(expected_difference["fit_percent"], abs=0.01)

    @pytest.mark.slow
    def test_two_axes(self, study, expected):
        for case in two_axes(study):
            assert not case.lagrangian.stopped and not case.newtonian.stopped
            for angle in ANGLES:
                expected_difference = expected["two_axes"][case.name][angle]
                angle_difference = case.differences[angle]
                assert angle_difference.rms == pytest.approx(
                    expected_difference["rms_rad"], rel=1e-3
                )
                assert angle_difference.fit == pytest.approx(
                    expected_difference["fit_percent"], abs=0.01
                )
            for speed in ("omega_v", "omega_h"):
                assert case.differences[speed].largest == 0.0

    @pytest.mark.slow
    def test_models_agree_where_they_must(self, study, expected):
        agreements, terms = study_agreement(study)
        *exact, integration = agreements
        for agreement in exact:
            assert agreement.largest < 1e-12 < 1e-3 < agreement.travel
        assert integration.largest == pytest.approx(
            expected["agreement_rad"][integration.what], rel=0.05
        )
        for term in terms:
            expected_rms = expected["terms_rms_rad"][term.name]
            for name, values in {"all": term.newtonian, **term.left_wrong}.items():
                for angle, value in values.items():
                    assert value == pytest.approx(expected_rms[name][angle], rel=1e-3, abs=1e-9)

    @pytest.mark.slow
    def test_bench_tests_find_what_their_instruments_allow(self, study, expected):
        estimates, _ = study_bench_tests(study, seed=1)
        for f in estimates:
            expected_estimate = expected["bench_tests"][f.name]
            n = study.bench_tests.repetitions
            # Another seed: within what its own spread allows.
            assert f.sd == pytest.approx(expected_estimate["sd"], rel=0.4)
            assert (
                abs(f.mean - expected_estimate["mean"])
                < 4.5 * expected_estimate["sd"] * (2 / n) ** 0.5
            )


class TestPage:
    def test_its_tables_are_those_of_the_expected_figures(self, expected):
        text = PAGE.read_text(encoding="utf-8")
        for name, case in expected["two_axes"].items():
            (row,) = re.findall(rf"^\| {name} \| ([\d. |–]+) \|$", text, re.MULTILINE)
            cells = [float(cell) for cell in row.split(" | ")]
            expected_cells = [
                value
                for angle in ANGLES
                for value in (
                    1e3 * case[angle]["rms_rad"],
                    1e3 * case[angle]["max_rad"],
                    case[angle]["fit_percent"],
                )
            ]
            assert cells == pytest.approx(expected_cells, abs=0.051)
        for name, value in expected["bench_tests"].items():
            assert f"| `{name}` |" in text
            assert f"{value['true']:.4g}" in text

    def test_what_the_prose_claims(self, expected):
        # The opposing terms, and the inductance.
        square = expected["terms_rms_rad"]["main_square"]
        for term in ("coriolis", "turning"):
            assert square[term]["alpha_h"] > square["all"]["alpha_h"]
        cases = expected["terms_rms_rad"]
        assert all(case["centrifugal"][angle] < 0.01 for case in cases.values() for angle in ANGLES)
        for name in ("main_square", "level_yaw", "two_squares", "pitch_resonance", "two_chirps"):
            yaw = {term: cases[name][term]["alpha_h"] for term in TERMS}
            assert min(yaw["coriolis"], yaw["turning"]) > max(yaw["inertia"], yaw["centrifugal"])
            pitch = {term: cases[name][term]["alpha_v"] for term in TERMS}
            assert max(pitch, key=pitch.__getitem__) == "inertia"
        for name in ("tail_square", "level_yaw", "two_sines", "fast_yaw"):
            assert cases[name]["arm"]["alpha_h"] > cases[name]["all"]["alpha_h"]
        assert expected["bench_tests"]["B_mr"]["sd"] > 0.2 * expected["bench_tests"]["B_mr"]["true"]

    def test_a_lost_mark_is_told(self, tmp_path: Path):
        file = tmp_path / "page.md"
        file.write_text("<!-- a: begin -->\nold\n<!-- a: end -->\n", encoding="utf-8")
        write_tables(file, {"a": "new"})
        assert "new" in file.read_text() and "old" not in file.read_text()
        with pytest.raises(ConfigurationError, match="lost its marks"):
            write_tables(file, {"b": "new"})


@pytest.mark.slow
def test_control_hardly_minds_as_the_page_says(tmp_path) -> None:
    from trms_cli.cli import main as trms

    rmse, overshoot = [], []
    for number, words in enumerate((["model=lagrangian"], ["model=newtonian"])):
        out = tmp_path / str(number)
        words = [*words, "model@plant.model=lagrangian", "sim.duration=40", "picture=false"]
        assert trms(["run", *words, f"out={out}"]) == 0
        channels = json.loads((out / "score.json").read_text())["channels"]
        rmse += [channels[angle]["rmse"] for angle in ANGLES]
        overshoot.append(channels["alpha_h"]["overshoot_percent"])
    page = PAGE.read_text(encoding="utf-8")
    sentence = re.search(
        r"RMSE of (.+?) rad in pitch and (.+?) rad in yaw .*?model, (.+?) and (.+?) rad .*?"
        r"overshoots by (.+?) % and by (.+?) %",
        page,
    )
    assert sentence is not None
    assert rmse == pytest.approx([float(figure) for figure in sentence.groups()[:4]], abs=6e-4)
    assert overshoot == pytest.approx([float(figure) for figure in sentence.groups()[4:]], abs=0.1)
