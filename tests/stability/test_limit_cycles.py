"""The study of limit cycles on the rig's models."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.integrate import trapezoid

from trms_cli.controllers.lqr import Lqr
from trms_cli.core.chart import Curve
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extended
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.models.vector_field import VectorField
from trms_cli.observers.full_state import FullState
from trms_cli.stability.cycles.orbits import Shooting, search_orbits
from trms_cli.stability.local.linear import Linear
from trms_cli.stability.studies.limit_cycles import LimitCycles
from trms_cli.stability.study import Study, silent
from trms_cli.stability.subject import LoopParts, Subject, not_level

SHORT = {"starts": 6, "duration": 40.0, "orbits": 45}


def asked(model, **keys):
    return LimitCycles(**{**SHORT, **keys}).run(Subject(model, "m"), silent)


@pytest.fixture(scope="module")
def strong_cross_moment():
    """The set `rahideh`, k_g = 0.2, where a stable and an unstable cycle surround the hover."""
    at = {"alpha_v": 0.17, "alpha_h": 0.3}
    keys = {"starts": 8, "duration": 60.0, "box": {"alpha_v": 0.9}}
    return asked(Newtonian(parameter_set="rahideh"), at=at, **keys)


def test_is_a_study():
    assert isinstance(LimitCycles(), Study)


@pytest.mark.parametrize("freedom", ["vertical", "horizontal"])
def test_of_one_axis_there_is_none_and_the_lead_says_proved(freedom):
    findings = asked(Newtonian(freedom=freedom))
    assert "no limit cycle" in findings.lead[0] and "proved" in findings.lead[0]
    proof = findings.results["proof"]
    assert proof["no_cycle"] and proof["everywhere"]
    assert findings.results["cycles"] == [] and findings.results["over"]["hopf"] == []
    json.dumps(findings.results, allow_nan=False)


def test_with_the_cross_moment_of_physics_none_is_found_and_no_hopf_point():
    findings = asked(Newtonian())
    assert "not a proof" in findings.lead[0] and "certified" in findings.lead[1]
    assert findings.results["cycles"] == [] and findings.results["over"]["hopf"] == []
    assert not findings.results["proof"]["no_cycle"]


def test_without_losses_orbits_are_no_limit_cycles():
    """k_ov = 0: a pendulum, around whose rest orbits of all sizes lie."""
    model = Newtonian(freedom="vertical")
    model.parameters = model.parameters.replaced({"k_ov": 0.0})
    findings = asked(model)
    results = findings.results
    assert results["cycles"] == [] and len(results["continuum"]) >= 3
    assert results["over"]["hopf"] == [] and results["over"]["branches"] == []
    assert findings.lead[0].startswith("No limit cycle was found, but a continuum")
    assert "unstable" not in " ".join(findings.lead)
    periods = [orbit["period"] for orbit in results["continuum"]]
    assert periods == sorted(periods) and periods[-1] < 2 * periods[0]
    json.dumps(results, allow_nan=False)


def test_two_cycles_around_a_stable_hover(strong_cross_moment):
    unstable, stable = strong_cross_moment.results["cycles"]
    assert strong_cross_moment.results["continuum"] == []
    assert not unstable["stable"] and stable["stable"]
    assert unstable["period"] == pytest.approx(4.302, abs=0.002)
    assert stable["period"] == pytest.approx(4.622, abs=0.002)
    # The unstable one lies within the stable one, and around the equilibrium.
    low, high = ([c["lowest"]["alpha_v"], c["highest"]["alpha_v"]] for c in (unstable, stable))
    assert high[0] < low[0] < 0.17 < low[1] < high[1]
    for cycle in (unstable, stable):
        assert cycle["trivial_error"] < 1e-6 and cycle["misfit"] < 1e-8
        # The rotors are driven by nothing but their commands: they stand still on a cycle.
        assert cycle["lowest"]["omega_v"] == pytest.approx(cycle["highest"]["omega_v"])
    json.dumps(strong_cross_moment.results, allow_nan=False)


def test_the_multipliers_have_the_product_of_liouville():
    """∏ μ = exp ∮ div f dt, along the orbit that a motion settles on."""
    model = Newtonian(parameter_set="rahideh")
    point = operating_point(model, {"alpha_v": 0.17, "alpha_h": 0.3})
    start = point.x.copy()
    start[model.state_index("alpha_v")] -= 0.8
    found = search_orbits(model, start[None], point.u, 60.0, Shooting(model))
    (orbit,) = [orbit for orbit in found.orbits if orbit.stable]
    field = VectorField(model)
    divergence = [np.trace(field.linearised(x, point.u)[0]) for x in orbit.path]
    expected = trapezoid(divergence, orbit.time)
    assert np.log(np.abs(np.prod(orbit.multipliers))) == pytest.approx(expected, rel=1e-4)


def test_the_hopf_point_is_subcritical_and_the_branch_folds(strong_cross_moment):
    over = strong_cross_moment.results["over"]
    (hopf,) = over["hopf"]
    model = Newtonian(parameter_set="rahideh")
    assert hopf["x"][model.state_index("alpha_v")] == pytest.approx(0.29, abs=0.003)
    branch = over["branches"][0]
    assert not any(branch["stable"][:10]) and branch["u"][5] < hopf["u"]
    fold = branch["changes"][0]
    assert fold["kind"] == "fold" and fold["u"] == pytest.approx(1.645, abs=0.002)
    assert any("subcritical" in sentence for sentence in strong_cross_moment.lead)


def test_on_the_cable_s_switch_the_hopf_point_is_that_of_the_mean():
    model = Newtonian(parameter_set="rahideh")
    findings = asked(model, at={"alpha_v": 0.17}, starts=1, orbits=12)
    (hopf,) = findings.results["over"]["hopf"]
    x, u = np.array(hopf["x"]), np.array([hopf["u"], findings.results["at"]["u"]["u_h"]])
    assert Linear(model).switches(x, u)
    growth = np.linalg.eigvals(Linear(model).a(x, u, "mean")).real
    assert np.abs(growth).min() < 1e-6
    for side in ("upper", "lower"):
        assert np.abs(np.linalg.eigvals(Linear(model).a(x, u, side)).real).min() > 1e-4
    assert any("mean of both sides" in words for words in findings.lead)
    # The multipliers of the smallest cycles are 1 within their accuracy: no fold.
    assert findings.results["over"]["branches"][0]["changes"] == []


def test_the_curves_of_stable_and_unstable_cycles_meet_at_the_fold(strong_cross_moment):
    chart = strong_cross_moment.charts[-1]
    fold = strong_cross_moment.results["over"]["branches"][0]["changes"][0]
    for panel in chart.panels:
        curves = [mark for mark in panel.marks if isinstance(mark, Curve)]
        blue = [mark for mark in curves if mark.colour == "blue"]
        red = [mark for mark in curves if mark.colour == "vermilion"]
        assert blue and red
        for one, other in zip(blue, red, strict=True):
            drawn, beside = (np.isfinite(np.asarray(mark.y)) for mark in (one, other))
            # They share the changes alone.
            shared = np.asarray(one.x)[drawn & beside]
            changes = strong_cross_moment.results["over"]["branches"][0]["changes"]
            assert np.all(np.isin(shared, [change["u"] for change in changes]))
            assert fold["u"] in shared


def test_its_figures(strong_cross_moment):
    names = [chart.name for chart in strong_cross_moment.charts]
    assert names == ["limit_cycles", "floquet_multipliers", "cycles_over_command"]


def test_with_dry_friction_motions_alone_are_looked_at():
    rig = extended(
        Newtonian(freedom="vertical"), {"friction": CoulombFriction(axis="pitch", torque=0.01)}
    )
    findings = asked(rig)
    assert not findings.results["proof"]["no_cycle"] and "over" not in findings.results
    assert findings.results["motions"]["rest"] == 6
    assert any("no slopes" in words for words in findings.warnings)
    assert "Without the dry friction none exists, whatever the start: proved" in findings.lead[0]


def test_another_point_than_the_usual_one_is_told():
    model = Newtonian(freedom="vertical")
    rest = operating_point(model, {})
    level = operating_point(model, {"alpha_v": 0.0})
    assert not_level(model, {}, level) == () and not_level(model, {"u_v": 0.0}, rest) == ()
    (words,) = not_level(model, {}, rest)
    assert "no equilibrium at alpha_v = 0 rad" in words and "rest without command" in words


def test_what_makes_no_sense_is_told():
    model = Newtonian()
    loop = LoopParts(
        model, Lqr(), FullState(), 0.02, {"controller": "lqr", "observer": "full_state"}
    )
    with pytest.raises(ConfigurationError, match="model alone") as told:
        LimitCycles().run(Subject(model, "m", loop), silent)
    assert "hunting" in told.value.remedy
    for keys, where in (({"over": "u_x"}, "over"), ({"box": {"q": 1.0}}, "box.q")):
        with pytest.raises(ConfigurationError) as told:
            LimitCycles(**keys).run(Subject(model, "m"), silent)
        assert told.value.where == where and told.value.remedy


def test_a_model_that_only_steps_is_refused():
    class Stepping(Newtonian):
        sample_time = 0.02

    with pytest.raises(ModelError, match="only steps"):
        LimitCycles().run(Subject(Stepping(), "net"), silent)
