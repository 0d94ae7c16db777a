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
from experiments.chapter2.rotors import study_rotor
from experiments.chapter2.simulation import difference
from experiments.chapter2.study import signal
from experiments.page_tables import write_tables
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.newtonian import Newtonian


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
