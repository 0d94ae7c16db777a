"""The study of chapter 8: what it reads, what its page claims, and that its figures are its own."""

import re

import numpy as np
import pytest

from experiments.chapter8.__main__ import PAGE
from experiments.chapter8.coverage import study_coverage, study_standstill
from experiments.chapter8.laws import Bench, study_laws
from experiments.chapter8.runs import cases, run_case


def test_the_starts_are_those_of_the_thesis(study):
    assert study.starts == [(1.2, 0.65), (-0.65, -0.35), (-1.27, -0.47), (0.64, 0.43)]


class TestExpectation:
    def test_the_standing_rotor(self, study, expected):
        for gain in study_standstill(study):
            expected_gain = expected["standstill"][gain.name]
            assert gain.weakest == pytest.approx(expected_gain["weakest"], rel=0.02, abs=1e-4)
            if expected_gain["gamma"] is not None:
                assert gain.gamma == pytest.approx(expected_gain["gamma"], rel=0.02)

    def test_polytopes_hold_the_model(self, study, expected):
        study.coverage.points, study.coverage.sizes = 2000, [0.3]
        checks, _ = study_coverage(study)
        expected_checks = [c for c in expected["coverage"] if c["size"] == 0.3]
        for here, there in zip(checks, expected_checks, strict=True):
            assert here.inside == pytest.approx(there["inside"], abs=0.01)
            assert here.largest == pytest.approx(there["largest"], rel=0.3)

    def test_offline_from_a_start(self, study, expected):
        case = next(c for c in cases(study, quick=True) if c.controller == "offline")
        ran = run_case(case)
        (expected_run,) = (
            r
            for r in expected["runs"]
            if (r["controller"], r["observer"], tuple(r["start"]))
            == ("offline", case.observer, case.start)
        )
        for angle, value in ran.ise.items():
            assert value == pytest.approx(expected_run["ise"][angle], rel=0.02)
        assert ran.failed == 0 and ran.largest <= 2.5

    @pytest.mark.slow
    def test_laws(self, study, expected):
        for law, expected_law in zip(study_laws(study), expected["laws"], strict=True):
            assert (law.kind, law.region, law.vertices) == (
                expected_law["kind"], expected_law["region"], expected_law["vertices"]
            )  # fmt: skip
            if expected_law["gamma"] is not None and expected_law["slack"] == 0:
                assert law.certificate is not None
                assert law.certificate.gamma == pytest.approx(expected_law["gamma"], rel=0.02)


class TestPage:
    def test_its_tables_are_those_of_the_expected_figures(self, expected):
        text = PAGE.read_text(encoding="utf-8")
        for name, share in expected["domain"].items():
            assert f"| {name} | {100 * share:.0f} |" in text
        rows = re.findall(r"^\| \(([-\d.]+), ([-\d.]+)\) \| ([\w\- ,]+) \| ([\d.]+) \| ([\d.]+) \|",
                          text, re.MULTILINE)  # fmt: skip
        expected_ise = {
            (*run["start"], run["controller"]): run["ise"]
            for run in expected["runs"]
            if run["observer"] == "full_state"
        }
        assert len(rows) == len(expected_ise)
        for yaw, pitch, controller, *values in rows:
            ise = expected_ise[float(yaw), float(pitch), controller]
            assert [float(v) for v in values] == pytest.approx(
                [ise["alpha_h"], ise["alpha_v"]], abs=0.0051
            )

    def test_what_the_prose_claims(self, expected):
        runs = expected["runs"]
        assert all(run["largest"] <= 2.5 for run in runs)
        # Every start is regulated by every controller of the page that is meant for use.
        for run in runs:
            if run["controller"] in ("sub-polytope", "offline", "newton_mpc"):
                assert run["settling"]["alpha_v"] is not None
        # The switched cost stays below the certified one, and V never rises.
        for law in expected["laws"]:
            if law["cost"] is not None:
                assert law["cost"] <= 1.0 + 1e-3 and law["rise"] <= 1.0 + 1e-3
        # Own Lyapunov matrices are never more conservative where no slack clouds it.
        bounds = {
            (*law["start"], law["region"], law["kind"]): law
            for law in expected["laws"]
            if law["vertices"] == 4
        }
        for (*start, region, kind), law in bounds.items():
            if kind == "parameter_dependent" and law["gamma"] is not None and law["slack"] == 0:
                common = bounds[*start, region, "common"]
                if common["gamma"] is not None and common["slack"] == 0:
                    assert law["gamma"] <= 1.01 * common["gamma"]
        # In the speed the yaw has a vertex without gain; in the thrust it has not.
        still = expected["standstill"]
        assert still["speed"]["weakest"] < 0.05 < 0.5 < still["thrust"]["weakest"]
        # What the prose says of four and eight vertices, and of the cost of robustness.
        by_vertices = {
            n: [law["decreasing"] for law in expected["laws"]
                if law["vertices"] == n and law["kind"] == "common"]
            for n in (4, 8)
        }  # fmt: skip
        assert 0.7 < min(by_vertices[4]) < 0.8 and 0.98 < min(by_vertices[8]) < 0.985
        full_state_runs = [run for run in runs if run["observer"] == "full_state"]
        cost = {
            name: np.mean([r["ise"]["alpha_h"] for r in full_state_runs if r["controller"] == name])
            for name in ("sub-polytope", "offline", "newton_mpc")
        }
        assert cost["sub-polytope"] / cost["newton_mpc"] == pytest.approx(2.9, abs=0.06)
        assert cost["offline"] / cost["newton_mpc"] == pytest.approx(3.6, abs=0.06)
        # newton_mpc holds more starts.
        domain = expected["domain"]
        for rotor in ("main rotor turning", "main rotor at rest"):
            assert domain[f"newton_mpc, {rotor}"] >= domain[f"online, {rotor}"]


def test_the_bench_is_the_controller_as_configured() -> None:
    bench = Bench()
    assert bench.regulation.coordinates.names[0] == "psi_omega_h"
    z = bench.deviation((0.5, 0.0), hover=True)
    row = bench.regulation.coordinates.names.index("alpha_h")
    assert np.flatnonzero(np.abs(z) > 1e-6).tolist() == [row]
