"""The study of regions of attraction, as the command line asks for it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from trms_cli.composition.composer import compose
from trms_cli.core.chart import as_data
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.library.tasks import stability as request
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.attraction.loop_region import LinearLawLoop, linear_law
from trms_cli.stability.attraction.region import ConfidenceShare, share_of
from trms_cli.stability.closed_loop import run_loop
from trms_cli.stability.studies.region_of_attraction import percent
from trms_cli.stability.study import silent

FEW = ("study.samples=100", "study.grid=9")


def answered(*overrides):
    composition = compose(["study=region_of_attraction", *overrides], "stability")
    return request.findings_of(request.request_of(composition), silent)


@pytest.fixture(scope="module")
def pitch():
    return answered(
        "model=newtonian_vertical", "study.methods=[lyapunov,integrals]", "study.boxes=20000", *FEW
    )


def test_the_answer_for_pitch(pitch):
    assert "proved to come to rest" in pitch.lead[0]
    assert any("none failed" in sentence for sentence in pitch.lead)
    data = json.loads(json.dumps(pitch.results, allow_nan=False))
    assert data["states"] == ["S_v", "alpha_v"] and data["settled"] == ["omega_v"]
    assert data["point"]["alpha_v"] == pytest.approx(0.271, abs=5e-4)  # check value, 1.8 V
    kinds = {e["method"]: e for e in data["estimates"] if e["proved"]}
    assert kinds["integrals"]["volume"] > 5.0 * kinds["lyapunov"]["volume"]
    for estimate in kinds.values():
        assert estimate["failed"] == 0 and estimate["simulated"] > 0
        share = estimate["share_of_true_region"]
        assert 0.0 < share["lower"] <= share["value"] <= share["upper"]
    saddle = next(e for e in data["other_equilibria"] if not e["stable"])
    assert saddle["deviation"]["alpha_v"] == pytest.approx(1.3615, abs=1e-3)


def test_the_figure_shows_region_estimates_and_saddle(pitch):
    chart = next(c for c in pitch.charts if c.name == "region_of_attraction")
    marks = chart.panels[0].marks
    labels = {getattr(mark, "label", "") for mark in marks}
    assert {"comes to rest (simulated)", "saddle", "with integrals of the rates"} <= labels
    assert as_data(chart)["panels"]


@pytest.mark.slow
def test_rotors_may_deviate_too():
    found = answered(
        "model=newtonian_vertical", "study.states=all", "study.methods=[inclusion]", *FEW
    )
    assert found.results["states"] == ["omega_v", "S_v", "alpha_v"]
    estimate = found.results["estimates"][0]
    assert estimate["proved"] and estimate["half_widths"]["omega_v"] > 3.0
    assert estimate["failed"] == 0


@pytest.mark.slow
def test_a_box_that_is_given_is_kept_to():
    found = answered(
        "model=newtonian_vertical",
        "study.methods=[lyapunov]",
        "study.box={alpha_v: 0.05, S_v: 0.6}",
        *FEW,
    )
    assert found.results["box"] == {"S_v": 0.6, "alpha_v": 0.05}
    assert found.results["estimates"][0]["half_widths"]["alpha_v"] <= 0.05


@pytest.mark.parametrize(
    ("overrides", "kind", "words"),
    [
        # 0.0234: of the mean of both sides of yaw zero, as study=local has it
        (["model=rahideh", "study.at={alpha_v: 0.4}"], ModelError, "unstable.*0.0234"),
        (["model=narx_2dof"], ModelError, "only steps"),
        (["model=newtonian_vertical", "study.at={u_v: 2.4}"], ConfigurationError, "ends at"),
        (["model=newtonian_vertical", "study.box={alpha_x: 1.0}"], ConfigurationError, "alpha_x"),
        (["model=newtonian_vertical", "study.states=[alpha_x]"], ConfigurationError, "alpha_x"),
        (
            ["model=newtonian_vertical", "study.plane=[alpha_v, omega_v]"],
            ConfigurationError,
            "omega_v",
        ),
    ],
)
def test_bad_requests_are_told(overrides, kind, words):
    with pytest.raises(kind, match=words):
        answered("study.methods=[lyapunov]", *FEW, *overrides)


def test_the_lqr_law_as_equations_moves_as_the_sampled_loop():
    composition = compose(
        ["study=region_of_attraction", "model=newtonian_vertical", "controller=lqr"], "stability"
    )
    subject = request.request_of(composition).subject
    point = operating_point(subject.model, {"alpha_v": 0.0})
    law = linear_law(subject.model, subject.loop, point)
    loop = LinearLawLoop(subject.model, law)
    run = run_loop(subject.model, subject.loop, point, 6.0, offset={"alpha_v": -0.3})
    matrix, offset = loop.starts()
    start = loop.point.x + matrix @ np.array([0.0, 0.0, -0.3]) + offset
    path = VectorField(loop).motions(start, loop.point.u, 6.0, 0.02)[: len(run.x), 0, :3]
    # The law holds its command over 20 ms; the equations do not.
    assert np.abs(path[:, 1:] - run.x[:, 1:]).max() < 0.01
    assert np.abs(run.x[:, 2] - point.x[2]).max() == pytest.approx(0.3, rel=1e-6)


@pytest.mark.slow
def test_an_lqr_loop_is_proved_and_run():
    found = answered(
        "model=newtonian_vertical",
        "controller=lqr",
        "study.methods=[lyapunov,inclusion]",
        "study.loop_starts=3",
        "study.duration=12",
        *FEW,
    )
    law = found.results["law"]
    assert law["states"][-1] == "xi_alpha_v"
    best = max(law["estimates"], key=lambda e: e["volume"])
    assert best["proved"] and best["failed"] == 0 and best["half_widths"]["alpha_v"] > 0.1
    assert all(found.results["runs_in_proved_set"]["recovered"])
    assert len(found.results["runs"]["recovered"]) == 3


def test_another_controller_is_only_run():
    found = answered(
        "model=newtonian_vertical",
        "controller=pid",
        "study.loop_starts=3",
        "study.box={alpha_v: 0.3, S_v: 0.2}",
        "study.duration=30",
    )
    assert found.results["law"] is None
    assert any("Nothing is proved for pid" in warning for warning in found.warnings)
    assert found.results["runs"]["recovered"] == [True, True, True]


def test_newtonian_models_have_a_saddle_in_common_with_the_energy():
    # G sin(alpha_v + 0.6194) = l_m F_v: symmetric about the vertical of the centre of gravity.
    model = Newtonian(freedom="vertical")
    point = operating_point(model, {"u_v": 1.8})
    mirrored = point.x.copy()
    mirrored[2] = np.pi - 2.0 * 0.61941 - point.x[2]
    assert np.abs(VectorField(model).rates(mirrored, point.u)).max() < 1e-3


def test_a_set_is_told_from_to_and_as_no_box(pitch):
    best = max((e for e in pitch.results["estimates"] if e["proved"]), key=lambda e: e["volume"])
    low, high = best["extent"]["alpha_v"]
    assert low < 0.0 < high and high > -1.3 * low  # towards the saddle it goes further
    assert max(-low, high) == pytest.approx(best["half_widths"]["alpha_v"])
    assert "no box" in pitch.lead[0] and "half-widths" not in pitch.lead[0]
    assert "alpha_v −0.7" in pitch.lead[0] and "±" not in pitch.lead[0]


def test_labels_of_a_panel_are_drawn_in_it(pitch):
    _, near = next(c for c in pitch.charts if c.name == "region_of_attraction").panels
    labels = {getattr(mark, "label", "") for mark in near.marks}
    assert "Lyapunov equation" in labels
    assert not labels & {"with integrals of the rates", "saddle", "motions that do not"}


def test_open_loop_is_no_loop():
    with pytest.raises(ConfigurationError, match="there is no loop"):
        answered("model=newtonian_vertical", "controller=open_loop", "study.loop_starts=3")


@pytest.mark.parametrize("hits", [2000, 1999, 1990, 1500, 3, 0])
def test_intervals_have_enough_digits(hits):
    share = share_of(hits, 2000)
    told = percent(share)
    if share.value >= 1e-3:
        low, high = told.split("(")[1].removesuffix(" %)").split("–")
        assert low != high
        assert (float(low) < 100.0) and (high == "100") == (share.upper == 1.0)


def test_all_of_a_box_is_told_with_its_lower_end():
    assert percent(share_of(2000, 2000)) == "100 % (99.8–100 %)"


def test_a_cut_duration_is_told_and_widens_the_share():
    found = answered("model=rahideh", "study.at={alpha_v: 0.343}", "study.methods=[lyapunov]", *FEW)
    assert found.results["duration"] == 120.0
    assert any("what had not arrived is undecided" in sentence for sentence in found.warnings)
    share, undecided = found.results["true_share_of_box"], found.results["undecided"]
    assert undecided > 0 and share["upper"] >= share["value"] + undecided / 100.0
    assert all(e["failed"] == 0 for e in found.results["estimates"])
    assert not any("contradict" in sentence for sentence in found.lead)


def test_proofs_and_simulations_are_of_the_same_rig():
    found = answered(
        "model=newtonian_vertical",
        "effect=main_dead_zone",
        "study.at.u_v=1.0",
        "study.methods=[lyapunov]",
        *FEW,
    )
    assert [e["failed"] for e in found.results["estimates"]] == [0]
    assert any("main_dead_zone" in sentence for sentence in found.warnings)


def test_a_small_share_that_is_hardly_known_has_its_interval():
    assert percent(ConfidenceShare(5e-9, 1e-10, 2e-8)) == "5e-07 % (1e-08–2e-06 %)"
    assert percent(ConfidenceShare(5e-9, 4e-9, 6e-9)) == "5e-07 %"
