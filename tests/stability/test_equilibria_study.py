"""The study of equilibria as it is asked for and told."""

from __future__ import annotations

import json

import pytest

from trms_cli.core.chart import Note, as_data
from trms_cli.core.errors import ModelError, TrmsError
from trms_cli.core.findings import Findings
from trms_cli.effects.dead_zone import DeadZone
from trms_cli.effects.extended_model import ExtendedModel
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.tras import Tras
from trms_cli.stability.studies.equilibria import Equilibria
from trms_cli.stability.study import Study, silent
from trms_cli.stability.subject import Subject


def asked(model: object, **keys: object) -> Findings:
    study = Equilibria(**({"proof_range": False, "proof_points": 5, "map": False} | keys))  # type: ignore[arg-type]
    assert isinstance(study, Study)
    return study.run(Subject(model, "tested"), silent)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def found() -> Findings:
    return asked(Newtonian(), map=True)


def test_what_nothing_returns_is_marginal() -> None:
    found = asked(Tras(), over=("u_v",))
    assert "(marginal)" in found.lead[0] and "(stable)" not in " ".join(found.lead)
    assert {point["verdict"] for point in found.results["named"]} == {"marginal"}


def test_rest_and_hover_outside_the_box_are_left_out() -> None:
    found = asked(Newtonian(), box={"alpha_v": (2.0, 3.0)})
    assert not found.results["named"]
    told = " ".join(found.warnings)
    assert "rest lies outside the box" in told and "hover lies outside the box" in told
    assert "held at α_v = 0 rad, outside the box" in told


def test_a_dead_zone_leaves_no_rounding_in_hover() -> None:
    model = ExtendedModel(Newtonian(), "dead", DeadZone(rotor="main", width=0.1))
    hover = asked(model, over=("u_v",)).results["named"][1]
    assert hover["inputs"]["u_h"] == 0.0
    assert abs(hover["quantities"]["current_tail"]) < 1e-12


def test_figures_are_made(found: Findings) -> None:
    charts = {chart.name: chart for chart in found.charts}
    assert list(charts) == ["equilibria_u_v", "equilibria_u_h", "equilibria_map"]
    drawn = as_data(charts["equilibria_u_v"])
    assert [panel["y"]["label"] for panel in drawn["panels"]] == ["α_v", "ω_v"]
    labels = {mark.get("label") for mark in drawn["panels"][0]["marks"]}
    assert {"stable", "unstable", "proved", "fold", "stop"} <= labels
    notes = {m.text: m for m in charts["equilibria_u_v"].panels[0].marks if isinstance(m, Note)}
    assert notes["hover"].x > 1.413 and notes["hover"].y < -0.1  # beneath a curve that rises


def test_results_are_json_with_all_that_was_found(found: Findings) -> None:
    results = json.loads(json.dumps(found.results, allow_nan=False))
    survey = results["surveys"][0]
    assert survey["over"] == "u_v" and len(survey["proofs"]) == 5
    assert all(proof["complete"] and proof["agrees_with_curves"] for proof in survey["proofs"])
    fold = next(one for one in survey["landmarks"] if one["kind"] == "fold")
    assert abs(fold["input"] - 2.2272) < 1e-4
    assert [point["name"] for point in results["named"]] == ["rest", "hover"]
    (warning,) = set(found.warnings)
    assert "mean of both" in warning and "α_h = 0" in warning
    curve = survey["curves"][0]
    assert len(curve["states"]["alpha_v"]) == len(curve["growing"]) == len(curve["inputs"]["u_v"])


def test_special_points_and_ranges_of_ones_own() -> None:
    found = asked(
        Newtonian(freedom="vertical"),
        special={"nose up": {"alpha_v": 0.4}},
        range={"u_v": (0.0, 2.3)},
        box={"alpha_v": (-0.7, 1.0)},
    )
    named = {point["name"]: point for point in found.results["named"]}
    assert abs(named["nose up"]["states"]["alpha_v"] - 0.4) < 1e-9
    survey = found.results["surveys"][0]
    assert survey["range"] == [0.0, 2.3]
    assert survey["box"]["alpha_v"] == [-0.7, 1.0]
    assert survey["curves"][0]["ends"] == ["end of the range", "alpha_v = 1 rad"]


def test_a_beam_driven_by_its_rotors_speeds() -> None:
    model = DrivenModel(Newtonian(), ("omega_v", "omega_h"))
    with pytest.raises(ModelError, match="have no limits"):
        asked(model)
    found = asked(model, over=("omega_v",), range={"omega_v": (0.0, 300.0)})
    fold = next(one for one in found.results["surveys"][0]["landmarks"] if one["kind"] == "fold")
    assert abs(fold["input"] - 257.654) < 1e-2


@pytest.mark.parametrize(
    ("keys", "where"),
    [
        ({"over": ("u_x",)}, "study.over"),
        ({"over": ()}, "study.over"),
        ({"range": {"u_v": (1.0, 1.0)}}, "study.range.u_v"),
        ({"range": {"uv": (0.0, 1.0)}}, "study.range"),
        ({"at": {"alpha_h": 0.0}}, "study.at"),
        ({"box": {"alpha_h": (-1.0, 1.0)}}, "study.box.alpha_h"),
        ({"at": {"alpha_v": 5.0}}, "study.at.alpha_v"),
        ({"box": {"alpha_v": (1.0, -1.0)}}, "study.box.alpha_v"),
        ({"special": {"far": {"alpha_v": 2.0}}}, "study.special.far"),
    ],
)
def test_what_makes_no_sense_is_refused(keys: dict[str, object], where: str) -> None:
    with pytest.raises(TrmsError) as refused:
        asked(Newtonian(freedom="vertical"), **keys)
    assert refused.value.where == where
    assert refused.value.remedy


def test_an_upright_beam_in_the_box_is_told() -> None:
    with pytest.raises(ModelError, match="may be singular"):
        asked(Lagrangian(), box={"alpha_v": (-1.6, 1e9)}, over=("u_v",))
    with pytest.raises(ModelError, match="beam upright") as refused:
        asked(QuanserAero(), box={"alpha_v": (-3.0, 3.0)})
    assert refused.value.where == "study.box.alpha_v"
