"""study=lyapunov: what it claims holds, what does not hold is shown, and bad requests are told; the
table of docs/stability-lyapunov.md is what the program finds.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.findings import Findings
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.inflow import Inflow
from trms_cli.effects.sensor_bias import SensorBias
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.models.tras import Tras
from trms_cli.models.twin_rotor import TwinRotor
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.lyapunov.candidate import rays
from trms_cli.stability.lyapunov.certificate import (
    LyapunovCertificate,
    StabilityClaim,
    certify,
    identity_residual,
    motions,
    on_level,
    rig_of,
)
from trms_cli.stability.studies.lyapunov import Lyapunov, data, lead
from trms_cli.stability.study import silent
from trms_cli.stability.subject import Subject

#: Enough for the claims; the study itself takes more boxes.
BUDGET = 600
MODELS = {
    "horizontal": lambda: Newtonian(freedom="horizontal"),
    "vertical": lambda: Newtonian(freedom="vertical"),
    "newtonian": lambda: Newtonian(),
    "lagrangian": lambda: Lagrangian(),
    "rahideh": lambda: Newtonian(parameter_set="rahideh"),
}


@cache
def certificate_of(
    name: str, at: tuple[tuple[str, float], ...], function: str = "auto", budget: int = BUDGET
) -> LyapunovCertificate:
    rig = rig_of(Subject(MODELS[name](), name))
    point = operating_point(rig.model, dict(at))
    return certify(rig, point, function, budget, 0, silent)


def run(model: Model, **options: object) -> Findings:
    study = Lyapunov(**({"budget": BUDGET, "starts": 3, "duration": 5.0} | options))  # type: ignore[arg-type]
    return study.run(Subject(model, "model"), silent)


HOVER = (("alpha_v", 0.0),)
VERTICAL = Newtonian(freedom="vertical")


def test_horizontal_is_globally_stable_at_any_command() -> None:
    for yaw in (0.0, 0.3, -0.8):
        found = certificate_of("horizontal", (("alpha_h", yaw),))
        assert found.holds and found.everywhere and math.isinf(found.outer)
        assert found.bounded_by.startswith("the stop alpha_h")


def test_vertical_well_ends_at_the_saddle_that_the_balance_gives() -> None:
    found = certificate_of("vertical", HOVER)
    assert found.holds and not found.everywhere
    # docs/model.md: G sin(α + 0.6194) = l_m F, so that the other side of the crest is α_s.
    below, above = found.search.wells.saddles or (0.0, 0.0)
    assert above == pytest.approx(math.pi - 2 * 0.6194, abs=2e-4)
    assert below == pytest.approx(-math.pi - 2 * 0.6194, abs=2e-4)
    G, tilt = 0.2646, 0.6194
    barrier = G * (2 * math.cos(tilt)) - G * math.sin(tilt) * (above - 0.0)
    assert found.outer == pytest.approx(barrier, rel=1e-3)
    # The set within the stops ends where the well is as high as at the nearer stop.
    at_stop = G * (math.cos(tilt) - math.cos(1.05 + tilt) - math.sin(tilt) * 1.05)
    assert found.inner == pytest.approx(0.999 * at_stop, rel=1e-3)
    assert found.bounded_by == "the stop alpha_v = 1.05 rad"
    # A hanging beam's well is as deep as it is high.
    assert certificate_of("vertical", ()).outer == pytest.approx(2 * G, rel=1e-3)


def test_thesis_values_fail_at_a_high_pitch_and_the_counterexample_is_one() -> None:
    found = certificate_of("rahideh", (("alpha_v", 0.4),))
    assert not found.holds and found.outer == 0.0 and found.rising is not None
    falls = next(claim for claim in found.claims if claim.name == "falls")
    assert falls.how == "failed"
    candidate = found.search.candidate
    # By the model's own equations and differences of V, not by the derivative that was searched.
    field = VectorField(candidate.energy.model)
    rates = field.rates(found.rising.x, candidate.energy.u)
    step = 1e-5
    after, before = (
        candidate.value(candidate.motions(found.rising.x + side * step * rates))[0]
        for side in (1, -1)
    )
    assert (after - before) / (2 * step) == pytest.approx(found.rising.derivative, rel=1e-3)
    assert found.rising.derivative > 0.0


@pytest.mark.parametrize(
    ("name", "at"), [("vertical", HOVER), ("horizontal", (("alpha_h", 0.3),)), ("newtonian", HOVER)]
)
def test_no_motion_leaves_the_inner_set(name: str, at: tuple[tuple[str, float], ...]) -> None:
    found = certificate_of(name, at)
    candidate, wells = found.search.candidate, found.search.wells
    starts = on_level(candidate, wells, found.inner, rays(candidate, 6, 7))
    assert len(starts) >= 5
    assert candidate.value(starts) == pytest.approx(found.inner, rel=1e-6)
    seen = motions(candidate, candidate.energy.model, starts, found.inner, 10.0)
    assert np.all(np.diff(seen.value, axis=0) <= 1e-7 * found.inner)
    assert seen.value.max() <= found.inner * (1.0 + 1e-6)
    angles = seen.y[:, :, 2 * candidate.energy.k :]
    stops = [candidate.energy.model.stops[f"alpha_{a}"] for a in candidate.energy.axes]
    assert np.all(np.abs(angles) <= stops)


def test_v_falls_at_random_states_of_the_outer_set() -> None:
    for name in ("newtonian", "lagrangian", "vertical"):
        found = certificate_of(name, HOVER)
        candidate, wells = found.search.candidate, found.search.wells
        directions = rays(candidate, 150, 2)
        places = [
            on_level(candidate, wells, share * found.outer, directions[i::3])
            for i, share in enumerate((0.1, 0.6, 0.999))
        ]
        y = np.concatenate(places)
        assert np.all(candidate.derivative(candidate.states(y)) < 0.0)


def test_dry_friction_only_helps_and_the_conclusion_is_a_set_of_rests() -> None:
    friction = {"pitch_coulomb_friction": CoulombFriction(axis="pitch", torque=0.002)}
    found = run(extend_model(VERTICAL, friction), at={"alpha_v": 0.0})
    assert found.results["holds"]
    assert "friction holds it" in found.lead[1]
    attracts = next(c for c in found.results["claims"] if c["name"] == "attracts")
    assert "F_c" in attracts["detail"]
    with pytest.raises(ConfigurationError, match="strict function"):
        run(extend_model(Newtonian(), friction), at={"alpha_v": 0.0, "alpha_h": 0.3})


def test_the_findings_carry_sets_claims_and_figures_and_sensors_change_nothing() -> None:
    bias = {"pitch_sensor_bias": SensorBias(axis="pitch", bias=0.1)}
    found, biased = (
        run(model, at={"alpha_v": 0.0}) for model in (VERTICAL, extend_model(VERTICAL, bias))
    )
    assert found.results == biased.results
    data = found.results
    assert data["function"] == "energy" and data["holds"]
    assert data["N"]["level"] > data["N_prime"]["level"] > 0
    low, high = data["N_prime"]["extent"]["alpha_v"]
    assert -1.05 <= low < 0 < high <= 1.05
    assert {c["name"] for c in data["claims"]} >= {"positive", "falls", "kept", "attracts", "seen"}
    drawn = {chart.name for chart in found.charts}
    assert drawn == {"lyapunov_well", "lyapunov_sets", "lyapunov_decay"}
    assert all(real < 0 for real, _ in data["eigenvalues"])


def test_an_unstable_point_is_told_from_a_function_that_fails() -> None:
    unstable = run(Newtonian(parameter_set="rahideh"), at={"alpha_v": 0.4})
    assert any("No other function" in line for line in unstable.lead)
    assert unstable.results["N"]["level"] == 0.0 and not unstable.results["holds"]
    stable = run(Lagrangian(), at={"alpha_v": 0.0, "alpha_h": 0.3}, function="energy")
    assert any("region_of_attraction" in line for line in stable.lead)


INFLOW = {"main_inflow": Inflow(rotor="main", coefficient=0.1)}


@pytest.mark.parametrize(
    ("model", "at", "kind", "words"),
    [
        (Tras(), {}, ModelError, "is not stated here"),
        (Newtonian(currents="dynamic"), {}, ModelError, "quasi-static"),
        (Newtonian(parameters={"k_ov": 0.0}), {}, ModelError, "viscous friction of pitch"),
        (Lagrangian(parameters={"k_chn": 0.0}), {}, ModelError, "yaw rests anywhere"),
        (extend_model(Newtonian(), INFLOW), {}, ModelError, "main_inflow"),
        (VERTICAL, {"u_v": 2.4}, ConfigurationError, "ends at"),  # beyond the fold
        (VERTICAL, {"alpha_v": 1.0}, ModelError, "crest"),  # a saddle
    ],
)
def test_what_has_no_energy_or_no_stable_rest_is_told(model, at, kind, words) -> None:
    with pytest.raises(kind, match=words):
        run(model, at=at)


@pytest.mark.parametrize("pitch", [0.93, 0.95])
def test_beside_the_fold_the_saddle_ends_the_sets_and_not_a_stop_beyond_it(pitch: float) -> None:
    found = certificate_of("vertical", (("alpha_v", pitch),))
    assert found.holds and found.bounded_by == "the saddle"
    assert 0.0 < found.inner < found.outer
    # G [cos β − cos(β + d) − sin β d] at the crest, β = ᾱ + δ, d = π − 2β.
    gravity = found.search.candidate.energy.gravity
    beta = pitch + math.atan2(-gravity[0], -gravity[1])
    d = math.pi - 2 * beta
    barrier = math.hypot(*gravity) * (2 * math.cos(beta) - math.sin(beta) * d)
    assert found.outer <= barrier
    # The well is taken to end 1e-4 rad before the crest.
    assert found.outer == pytest.approx(barrier, rel=0.02)


def test_the_derivation_is_checked_at_rest_and_a_wrong_one_fails() -> None:
    found = certificate_of("vertical", ())
    assert found.holds
    candidate = found.search.candidate
    assert identity_residual(candidate, 0) < 1e-10
    other = candidate.weighted(candidate.weights)
    wrong = replace(candidate.weights, rotor_v=candidate.weights.rotor_v * (1 + 1e-6))
    other.derivative = candidate.weighted(wrong).derivative  # type: ignore[method-assign]
    assert identity_residual(other, 0) > 1e-8


def test_the_lead_says_first_what_does_not_hold_and_that_there_is_no_inner_set() -> None:
    sound = certificate_of("vertical", ())
    rig = rig_of(Subject(MODELS["vertical"](), "vertical"))
    point = operating_point(rig.model, {})
    assert "is a Lyapunov function on N" in lead(sound, rig, point, -1.0)[0]
    failed = StabilityClaim("seen", "V falls", "failed", "")
    said = lead(sound, rig, point, -1.0, (failed,))
    assert "not shown" in said[0] and "“V falls” (failed)" in said[0]
    assert not any("no motion leaves" in line for line in said)
    none = replace(sound, inner=0.0, bounded_by="the stop alpha_v = 1.05 rad")
    assert any("There is no N′" in line for line in lead(none, rig, point, -1.0))
    inner = data(none, point, np.array([-1.0 + 0j]), ())["N_prime"]
    assert inner["level"] is None and inner["extent"] is None


PAGE = Path(__file__).parents[2] / "docs" / "stability-lyapunov.md"
#: The first cell of each row: the model, where it rests.
ROWS: dict[str, tuple[Any, dict[str, Any], dict[str, float]]] = {
    "horizontal, α_h = 0.3": (Newtonian, {"freedom": "horizontal"}, {"alpha_h": 0.3}),
    "vertical, rest (−0.619)": (Newtonian, {"freedom": "vertical"}, {}),
    "vertical, hover": (Newtonian, {"freedom": "vertical"}, {"alpha_v": 0.0}),
    "vertical, u_v = 2.2 V": (Newtonian, {"freedom": "vertical"}, {"u_v": 2.2}),
    "Lagrangian, hover": (Lagrangian, {}, {"alpha_v": 0.0}),
    "Lagrangian, hover, α_h = 0.3": (Lagrangian, {}, {"alpha_v": 0.0, "alpha_h": 0.3}),
    "Lagrangian, `tastemirov`, level": (
        Lagrangian,
        {"parameter_set": "tastemirov"},
        {"alpha_v": 0.0},
    ),
    "Newtonian, hover": (Newtonian, {}, {"alpha_v": 0.0}),
    "Newtonian, rest": (Newtonian, {}, {}),
    "Newtonian, hover, α_h = 0.3": (Newtonian, {}, {"alpha_v": 0.0, "alpha_h": 0.3}),
    "Newtonian, `rahideh`, hover": (Newtonian, {"parameter_set": "rahideh"}, {"alpha_v": 0.0}),
    "Newtonian, `rahideh`, α_v = 0.4": (Newtonian, {"parameter_set": "rahideh"}, {"alpha_v": 0.4}),
    "Lagrangian, `rahideh`, hover": (Lagrangian, {"parameter_set": "rahideh"}, {"alpha_v": 0.0}),
}
#: Rows that take more than a second or two.
LONG = ("Newtonian", "Lagrangian")


def rows() -> list[list[str]]:
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("| model, equilibrium"))
    found = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        found.append([cell.strip() for cell in line.strip("|").split("|")])
    return found


def cases() -> list[Any]:
    return [
        pytest.param(
            row, id=f"{row[0]} {row[1]}", marks=[pytest.mark.slow] * row[0].startswith(LONG)
        )
        for row in rows()
    ]


def test_every_row_is_known() -> None:
    assert len(rows()) >= 14
    assert {row[0] for row in rows()} == set(ROWS)


@pytest.mark.parametrize("row", cases())
def test_a_row_is_what_is_found(row: list[str]) -> None:
    kind, options, at = ROWS[row[0]]
    model: TwinRotor = kind(**options)
    function = row[1].split(",")[0]
    rig, point = rig_of(Subject(model, "model")), operating_point(model, at)
    found = certify(rig, point, function, Lyapunov().budget, 0, silent)
    assert (found.search.candidate.weights.strict) == (function == "strict")
    if "γ" in row[1]:
        assert found.search.candidate.weights.yaw == float(row[1].split("=")[1])
    depth, outer, inner = (cell.strip("*") for cell in row[2:5])
    assert found.everywhere == (outer == "all states")
    levels = found.search.wells.depth, found.outer, found.inner
    for cell, value in zip((depth, outer, inner), levels, strict=True):
        if cell == "none":
            assert value == 0.0
        elif cell not in ("–", "all states"):
            digits = len(cell.split(".")[1])
            assert value == pytest.approx(float(cell), abs=0.51 * 10.0**-digits)
    if "state with V̇ > 0 at" in row[5]:
        assert found.rising is not None
        assert found.rising.value == pytest.approx(float(row[5].split(" at ")[1]), rel=0.03)
    for stop in ("stop α_v = −1.05", "stop α_v = 1.05", "stop α_h = −2.8", "stop α_h = 2.8"):
        if stop in row[5]:
            plain = stop.replace("α", "alpha").replace("−", "-")
            assert found.bounded_by == f"the {plain} rad"
