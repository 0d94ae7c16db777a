"""Modes: check values, names, switches, multiple and zero eigenvalues, black boxes, tracking; lines
that are varied; modes that become others along a range. Root loci: crossings, exact sensitivities,
loops, the map, and what is refused.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.composition.composer import compose
from trms_cli.core.chart import Line, Points
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build
from trms_cli.effects.cable_hysteresis import CableHysteresis
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.inflow import Inflow
from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.newtonian import Newtonian, geometry
from trms_cli.models.operating_point import TrimSolver
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.local.linear import (
    EigenMode,
    Linear,
    Modes,
    RigPart,
    modes_of,
    modes_of_matrix,
    parts_of,
    spectrum_of,
)
from trms_cli.stability.local.sensitivity import (
    EntryShare,
    Sensitivity,
    entry_words,
    loops_through,
    moves,
    sensitivity,
    share_chart,
    state_words,
)
from trms_cli.stability.local.sweep import (
    OperatingPath,
    Track,
    crossings,
    match_spectra,
    sweep_eigenvalues,
    tracks_of,
)
from trms_cli.stability.local.tables import colours_of, points_alone, styles_of
from trms_cli.stability.studies.controllability import Controllability
from trms_cli.stability.studies.local import Local
from trms_cli.stability.studies.root_locus import (
    RootLocus,
    StabilityMap,
    map_section,
    stability_map,
)
from trms_cli.stability.study import silent

from .study_cases import RAHIDEH, answer


def modes_at(model, at, side="mean"):
    point = TrimSolver(model).first(at)
    return modes_of(model, Linear(model).matrices(point.x, point.u, side))


def by_name(modes):
    return {mode.name: mode.eigenvalue for mode in modes.modes}


# The published values are those of the mean of the cable's two slopes; see docs/model.md. −0.328 of
# the main rotor at rest is a central difference over a few rad/s: the exact slope is −0.3200.
PUBLISHED = {
    "rest": (
        (RAHIDEH, {}, "stable"),
        {"tail rotor": -1.687, "main rotor": -0.32, "yaw swing": -0.208 + 0.509j}
        | {"pitch swing": -0.047 + 2.028j},
    ),
    "hover": (
        (RAHIDEH, {"alpha_v": 0.0}, "stable"),
        {"tail rotor": -1.687, "main rotor": -1.471, "yaw swing": -0.151 + 0.444j}
        | {"pitch swing": -0.047 + 1.830j},
    ),
    "above": ((RAHIDEH, {"alpha_v": 0.4}, "unstable"), {"pitch swing": 0.023 + 1.270j}),
    "the makers' model": (
        (FeedbackManual(), {}, "marginal"),
        {"yaw rate": -5.0, "tail rotor": -1.0, "main rotor": -0.909, "reaction": -0.5}
        | {"pitch swing": -0.044 + 2.169j, "yaw free": 0.0},
    ),
    "quanser_aero": (
        (QuanserAero(parameter_set="quanser_aero"), {"alpha_v": 0.3}, "marginal"),
        {"yaw free": 0.0, "pitch swing": -0.084 + 1.275j},
    ),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_eigenvalues_with_their_names(name):
    (model, at, verdict), expected = PUBLISHED[name]
    modes = modes_at(model, at)
    eigenvalues = by_name(modes)
    for mode, value in expected.items():
        exact = value == round(value.real, 1)  # by the equation, not to three digits
        assert eigenvalues[mode] == pytest.approx(value, abs=1e-9 if exact else 6e-4)
    assert modes.verdict == verdict
    assert name != "the makers' model" or set(eigenvalues) == set(expected)
    if name == "quanser_aero":
        double = next(mode for mode in modes.modes if mode.multiplicity == 2)
        assert double.eigenvalue == pytest.approx(-20.0) and not double.defective


def test_damping_and_frequencies_of_a_pair_and_currents_as_modes_of_their_own():
    pair = next(m for m in modes_at(Newtonian(), {}).modes if m.name == "pitch swing")
    assert pair.natural_frequency == pytest.approx(abs(pair.eigenvalue))
    assert pair.damped_frequency / (2 * np.pi) == pytest.approx(0.323, abs=1e-3)
    assert pair.damping_ratio == pytest.approx(-pair.eigenvalue.real / abs(pair.eigenvalue))
    assert pair.time_constant == pytest.approx(-1 / pair.eigenvalue.real)
    assert pair.participation.sum() == pytest.approx(1.0)
    model = Newtonian(currents="dynamic")
    path = OperatingPath(model, {}, "alpha_v")
    tracks = tracks_of(model, sweep_eigenvalues(path, -0.2, 0.2, 5))
    fast = {track.name for track in tracks if track.fast}
    assert fast == {"armature current of the main motor", "armature current of the tail motor"}
    # −R/L, and a little for the back EMF.
    p = model.parameters
    for track in tracks:
        if track.fast:
            assert track.rates.real.max() == pytest.approx(-p["R"].value / p["L"].value, rel=1e-3)


def test_a_point_on_a_switch_has_both_sides():
    model = Newtonian()
    linear, point = Linear(model), TrimSolver(model).first({"alpha_v": 0.0})
    (switch,) = linear.switches(point.x, point.u)
    assert model.state_names[switch.state] == "alpha_h"
    (entry,) = switch.entries
    assert [model.state_names[k] for k in entry] == ["S_h", "alpha_h"]
    # −k_ch/J_h with the stiffness of each side.
    p = model.parameters
    assert switch.upper[0] / switch.lower[0] == pytest.approx(p["k_chp"].value / p["k_chn"].value)
    upper, lower, mean = (linear.a(point.x, point.u, side) for side in ("upper", "lower", "mean"))
    assert np.allclose(mean, (upper + lower) / 2, atol=1e-12)
    assert not np.allclose(upper, lower)
    away = TrimSolver(model).first({"alpha_v": 0.0, "alpha_h": 0.3})
    assert linear.switches(away.x, away.u) == ()
    # A rotor at rest is none: its thrust has no slope there.
    vertical = Newtonian(freedom="vertical")
    assert Linear(vertical).switches(vertical.rest(), np.zeros(1)) == ()
    assert p["k_fvp"].value != p["k_fvn"].value


def test_linearisation_is_that_of_the_vector_field():
    model = Newtonian()
    point = TrimSolver(model).first({"alpha_v": 0.1, "alpha_h": 0.4})
    found = Linear(model).matrices(point.x, point.u)
    a, b = VectorField(model).linearised(point.x, point.u)
    assert np.allclose(found.a, a) and np.allclose(found.b, b)


def test_double_eigenvalues_with_and_without_enough_eigenvectors_and_beside_others():
    parts = (RigPart("pitch", "angle"), RigPart("pitch", "rate"))
    chained = modes_of_matrix(np.array([[0.0, 1.0], [0.0, 0.0]]), parts)
    (mode,) = chained.modes
    assert mode.multiplicity == 2 and mode.defective
    assert mode.verdict == chained.verdict == "unstable"  # grows with t
    rotors = RigPart("main rotor"), RigPart("tail rotor")
    separate = modes_of_matrix(np.diag([-2.0, -2.0]), rotors)
    (mode,) = separate.modes
    assert mode.multiplicity == 2 and not mode.defective
    assert mode.participation == pytest.approx([0.5, 0.5])
    slow = modes_of_matrix(np.array([[-1.0, 1.0], [0.0, -1.0]]), parts)
    assert slow.modes[0].defective and slow.verdict == "stable"
    # Two rotors of equal lag drive one free axis: the pole takes part as its projector says.
    a = np.array([[-20.0, 0, 0, 0], [0, -20.0, 0, 0], [1.0, 2.0, -0.4, 0], [0, 0, 1.0, 0]])
    yaw = RigPart("yaw", "rate"), RigPart("yaw", "angle")
    modes = modes_of_matrix(a, (*rotors, *yaw)).modes
    names = ["main rotor and tail rotor together", "yaw rate", "yaw free"]
    assert [mode.name for mode in modes] == names
    assert modes[0].participation == pytest.approx([0.5, 0.5, 0, 0], abs=1e-9)


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6), st.floats(0.01, 100.0))
@settings(max_examples=40, deadline=None)
def test_participation_does_not_depend_on_units(entries, unit):
    a = np.array(entries).reshape(2, 3)
    a = np.vstack([a, [0.3, -0.7, -1.1]])
    parts = (RigPart("a"), RigPart("b"), RigPart("c"))
    scale = np.diag([1.0, unit, 1.0 / unit])
    before = modes_of_matrix(a, parts).modes
    after = modes_of_matrix(scale @ a @ np.linalg.inv(scale), parts).modes
    gaps = [abs(m.eigenvalue - n.eigenvalue) for m in before for n in before if m is not n]
    if min(gaps, default=1.0) < 0.05 or any(m.multiplicity > 1 for m in before):
        return  # near a defective matrix participation is ill conditioned
    for one, other in zip(before, after, strict=True):
        assert one.participation == pytest.approx(other.participation, abs=1e-5)


def test_tracks_keep_their_mode_where_eigenvalues_pass_each_other():
    # Two decoupled lags whose rates cross.
    before, after = (spectrum_of(np.diag([-1.0 - s, -1.05])) for s in (0.0, 0.1))
    found, sure = match_spectra(before, after)
    assert sure > 0.8
    rows = [int(np.argmax(np.abs(s.right[:, 0]))) for s in (before, found)]
    assert rows[0] == rows[1]


def test_a_sweep_passes_a_rotor_at_standstill_and_ends_where_the_equilibrium_does():
    model = Newtonian(freedom="vertical")
    sweep = sweep_eigenvalues(OperatingPath(model, {}, "u_v"), -1.0, 2.5, 15)
    assert sweep.values[-1] == pytest.approx(2.23, abs=5e-3)
    assert "ends" in sweep.high and not sweep.low
    # At the fold the stiffness of pitch, the product of its two eigenvalues, goes to zero.
    stiffness = [np.prod(np.sort(np.abs(row))[:2]) for row in sweep.eigenvalues]
    assert stiffness[-1] < 2e-3 * np.abs(sweep.eigenvalues[0]).max() ** 2
    sweep = sweep_eigenvalues(OperatingPath(Newtonian(), {}, "alpha_v"), -0.8, 0.2, 11)
    assert len(sweep.places) >= 11 and not sweep.low and not sweep.high
    rest = min(sweep.places, key=lambda place: abs(place.value + 0.6194))
    assert abs(rest.point.u[0]) < 0.5


def test_a_black_box_has_modes_in_continuous_time():
    config = compose(["study=local", "model=narx_2dof"], "stability").config
    modes = modes_at(build(config["model"], "model"), {})
    found = by_name(modes)
    swing = next(v for name, v in found.items() if name.startswith("pitch swing"))
    # The rig that it was trained on swings at 0.32 Hz, lightly damped.
    assert swing.imag / (2 * np.pi) == pytest.approx(0.32, abs=0.03)
    assert -0.15 < swing.real < 0
    assert modes.verdict == "stable"
    assert any(name.startswith("past samples") for name in found)


def test_the_study_answers_with_names_verdict_and_range():
    findings = answer(Local(at={"alpha_v": 0.4}, points=21), RAHIDEH)
    assert findings.results["at"]["verdict"] == "unstable"
    assert "Unstable" in findings.lead[0]
    assert "pitch swing" in findings.lead[1]
    (first, *_) = findings.results["crossings"]
    assert first["mode"] == "pitch swing" and first["unstable_above"]
    assert {c.name for c in findings.charts} == {"local_modes", "local_plane", "local_range"}
    assert findings.results["switches"][0]["state"] == "alpha_h"
    assert findings.warnings
    # No operating point beside a free yaw is said.
    findings = answer(Local(over="u_v", points=5), FeedbackManual())
    assert any("study.over=alpha_v" in sentence for sentence in findings.lead)


def test_states_of_effects_are_named_after_the_effect_and_its_size_can_be_varied():
    hysteresis = CableHysteresis(axis="yaw", torque=0.004, width=0.1)
    model = extend_model(Newtonian(), {"yaw_cable_hysteresis": hysteresis})
    assert parts_of(model)[-1] == RigPart("yaw cable hysteresis")
    # Of all memories that it may rest with, that of a rig without a past.
    point = TrimSolver(model).first({"alpha_v": 0.0})
    assert abs(point.x[-1]) < 1e-6 and abs(point.u[model.n_u - 1]) < 1e-6
    model = extend_model(Newtonian(), {"main_inflow": Inflow(rotor="main", coefficient=10.0)})
    path, sweep, _ = locus({"alpha_v": 0.0}, "main_inflow.coefficient", (0.0, 60.0), model=model)
    assert path.unit == "rad/m"
    pitch = np.argmax(np.abs(sweep.eigenvalues[0].imag))
    damping = sweep.eigenvalues[:, pitch].real
    assert np.all(np.diff(damping) < 0)  # inflow damps


def growth_in_simulation(alpha_v, duration=240.0):
    """Rate at which a pitch swing of 1e-4 rad grows in the nonlinear equations, both slopes in."""
    model = RAHIDEH
    point = TrimSolver(model).first({"alpha_v": alpha_v})
    start = point.x.copy()
    row = model.state_index("alpha_v")
    start[row] += 1e-4
    run = VectorField(model).motions(start, point.u, duration, 0.02, impulses=False)[:, 0, row]
    swing = run - alpha_v
    tops = np.flatnonzero((swing[1:-1] > swing[:-2]) & (swing[1:-1] >= swing[2:])) + 1
    tops = tops[tops > 2000]  # the other modes have died out
    return np.polyfit(tops * 0.02, np.log(swing[tops]), 1)[0]


def test_small_swings_across_the_switch_grow_and_turn_as_the_mean_of_both_slopes_says():
    # The crossing is at 0.3396 and 0.3541 rad with the slopes of either side, at 0.3468 with the
    # mean; the simulated swing decides for the mean, to 2 mrad.
    assert growth_in_simulation(0.3447) < 0 < growth_in_simulation(0.3489)
    modes = modes_at(RAHIDEH, {"alpha_v": 0.4})
    pitch = by_name(modes)["pitch swing"]
    assert growth_in_simulation(0.4, 120.0) == pytest.approx(pitch.real, rel=0.05)
    model = Newtonian(freedom="horizontal")
    yaw = by_name(modes_at(model, {}))["yaw swing"]
    start = [0.0, 0.05, 0.0]
    angle = VectorField(model).motions(start, [0.0], 40.0, 0.005, impulses=False)[:, 0, 2]
    k = np.flatnonzero((angle[:-1] < 0) & (angle[1:] >= 0))
    crossings = 0.005 * (k + angle[k] / (angle[k] - angle[k + 1]))
    found = 2 * np.pi / np.diff(crossings)
    assert found == pytest.approx(yaw.imag, rel=0.02)


STUDIES = (Local, RootLocus, Controllability)


@pytest.mark.parametrize("study", STUDIES)
@pytest.mark.parametrize("at", [{"u_v": 1.0}, {"u_v": 1.0, "u_h": 0.0}])
def test_the_first_command_in_at_is_varied_if_nothing_is_said(study, at):
    results = answer(study(at=at, points=5, range=(0.5, 1.5))).results
    line = results["locus" if study is RootLocus else "range"]
    assert line["over"] == "u_v"
    assert line["values"][0] == 0.5 and line["values"][-1] == 1.5
    if study is not RootLocus:
        assert results["at"]["u"]["u_v"] == pytest.approx(1.0)


ANGLE = "over=alpha_v varies an angle; at holds commands"
COMMAND = "over=u_h varies a command; at holds angles"
REVERSED = {"over": "alpha_v", "points": 5}


@pytest.mark.parametrize(
    ("study", "says"),
    [
        (Local(at={"alpha_x": 0.0}), ["alpha_v"]),
        (Local(over="k_q"), ["allowed"]),
        (Local(at={"alpha_v": 2.0}), ["closest"]),
        (Local(at={"alpha_v": 0.0, "u_h": 1.0}), ["others follow"]),
        (Local(range=(2.5, 2.7)), ["cannot rest"]),
        (RootLocus(over="k_g", range=(0.1, 0.1)), ["different"]),
        (RootLocus(over="k_ov", range=(-1.0, 0.1)), ["between"]),
        (RootLocus(over="k_g", at={"alpha_v": 0.1}, against="u_h", points=3), ["others follow"]),
        # A line that does not go with at: what does.
        *((of(at={"u_v": 1.0}, over="alpha_v"), [ANGLE, "study.over=u_v"]) for of in STUDIES),
        *((of(at={"alpha_v": 0.1}, over="u_h"), [COMMAND, "study.over=alpha_v"]) for of in STUDIES),
        # A reversed range, by its name.
        *((of(**REVERSED, range=(0.2, 0.1)), ["study.range=[0.1,0.2]"]) for of in STUDIES),
        (
            RootLocus(**REVERSED, against="k_g", against_range=(0.2, 0.1)),
            ["upper end comes first", "study.against_range=[0.1,0.2]"],
        ),
    ],
)
def test_bad_requests_say_what_is_possible(study, says):
    with pytest.raises(ConfigurationError) as refused:
        answer(study)
    told = f"{refused.value.problem} {refused.value.remedy}"
    assert all(words in told for words in says)


def test_beyond_the_fold_it_is_the_pitch_that_diverges():
    findings = answer(Local(points=41), RAHIDEH)
    hopf, fold, back = findings.results["crossings"]
    assert hopf["mode"] == "pitch swing" and hopf["value"] == pytest.approx(0.3468, abs=5e-4)
    # The fold is a real eigenvalue of the pitch; the pair beside it is by then mostly of yaw.
    assert fold["mode"] == "pitch divergence" and fold["value"] == pytest.approx(0.9514, abs=5e-4)
    assert fold["unstable_above"] and fold["frequency_rad_s"] == 0.0
    assert back["mode"] == "yaw and pitch swing" and not back["unstable_above"]
    sentences = " ".join(findings.sections[-1].text)
    assert "“yaw swing” is mostly of the pitch" in sentences
    # The same by the modes of a point beyond it, which know nothing of tracks.
    beyond = Local(at={"alpha_v": 1.0}, over="alpha_v", range=(0.99, 1.01), points=3)
    modes = {m["name"]: m for m in answer(beyond, RAHIDEH).results["at"]["modes"]}
    assert modes["pitch divergence"]["real"] > 0 > modes["yaw swing"]["real"]


def test_no_two_modes_look_alike_in_a_figure_and_a_map_draws_no_value_on_its_frame():
    def mode(name: str, value: complex) -> EigenMode:
        return EigenMode(name, value, np.ones(1), np.ones(1, complex), np.ones(1, complex))

    names = ["yaw swing", "yaw and main rotor together", *(f"thing {k}" for k in range(8))]
    modes = Modes(tuple(mode(name, complex(-1.0 - k)) for k, name in enumerate(names)))
    points = [m for m in points_alone("modes", modes).panels[0].marks if isinstance(m, Points)]
    assert len({(m.colour, m.marker) for m in points}) == len(names)
    tracks = [Track(n, n, (k,), np.zeros((2, 1), complex), False) for k, n in enumerate(names)]
    colours = colours_of(tracks)
    styles = styles_of(colours)
    assert len({(colours[name], styles[name]) for name in names}) == len(names)

    def lines(span: tuple[float, float]) -> list[Line]:
        path = OperatingPath(Newtonian(), {"alpha_v": 0.4}, "k_g")
        over, against = np.linspace(*span, 3), np.array([0.3, 0.5])
        growth = np.array([[-0.1, 0.0, 0.1], [-0.1, 0.0, 0.2]])
        mapped = StabilityMap("alpha_v", over, against, growth, np.empty((0, 2)))
        (chart,) = map_section(path, mapped).blocks
        return [mark for mark in chart.panels[0].marks if isinstance(mark, Line)]

    own = Newtonian().parameters["k_g"].value
    assert not lines((0.5 * own, own))
    (line,) = lines((0.5 * own, 2 * own))
    assert line.x == own and line.style == "dashed"


RANGE = (0.0123, 0.2)


def locus(at, over, span, side="mean", points=21, model=None):
    path = OperatingPath(model or Newtonian(), at, over, side)
    sweep = sweep_eigenvalues(path, *span, points)
    return path, sweep, crossings(path, sweep)


def test_crossings_are_on_the_axis_between_the_sides_and_at_the_published_angle():
    values = {}
    for side in ("lower", "mean", "upper"):
        path, _, (found,) = locus({"alpha_v": 0.4}, "k_g", RANGE, side)
        values[side] = found.value
        a = path.linear.a(found.place.point.x, found.place.point.u, side, found.place.condition.p)
        pair = max(np.linalg.eigvals(a), key=lambda v: v.real)
        assert abs(pair.real) < 1e-9
        assert found.frequency == pytest.approx(abs(pair.imag))
    assert values["upper"] < values["mean"] < values["lower"]
    assert values["mean"] == pytest.approx(0.148, abs=1e-3)
    # model.md: above 0.34 rad. The slopes of the upper side give it exactly, the mean 0.347.
    _, _, found = locus({}, "alpha_v", (-0.5, 0.8), "upper", 31, RAHIDEH)
    assert found[0].value == pytest.approx(0.3396, abs=5e-4)
    assert found[0].unstable_above and found[0].kind == "Hopf"


@pytest.mark.parametrize(
    ("at", "over", "span"),
    [
        ({"alpha_v": 0.4}, "k_g", RANGE),
        ({"alpha_v": 0.2, "alpha_h": 0.3}, "l_cb", (0.26, 0.30)),
        ({}, "alpha_v", (-0.2, 0.5)),
        ({"u_h": 0.5}, "u_v", (1.0, 1.9)),
    ],
)
def test_sensitivities_are_those_of_finite_differences(at, over, span):
    path, sweep, _ = locus(at, over, span, points=5, model=RAHIDEH)
    place = sweep.places[2]
    h = 1e-6 * (span[1] - span[0])
    for track in range(path.model.n_x):
        found = sensitivity(path, place, track)
        up, down = (path.following(place, place.value + step) for step in (h, -h))
        slope = (up.spectrum.values[track] - down.spectrum.values[track]) / (2 * h)
        assert found.total == pytest.approx(slope, rel=1e-4, abs=1e-4)
        assert sum(s.part for s in found.shares) == pytest.approx(found.total)


def test_the_crossing_over_k_g_is_of_the_gyroscopic_moment_in_a_loop_over_pitch_and_yaw():
    path, _, (found,) = locus({"alpha_v": 0.4}, "k_g", RANGE)
    why = sensitivity(path, found.place, found.track)
    first = why.shares[0]
    assert entry_words(path.model, first.row, first.column) == "pitch moment per yaw rate"
    assert first.part.real > 0.5 * why.total.real > 0
    # dA/dk_g = F_v cos α_v / J_v, as it stands in the equation of pitch.
    p = {parameter.name: parameter.value for parameter in path.model.parameters}
    thrust = p["k_fvp"] * found.place.point.x[path.model.state_index("omega_v")] ** 2
    assert first.change == pytest.approx(thrust * np.cos(0.4) / geometry(p)["J_v"])
    # The strongest loop through that moment.
    a = path.linear.a(found.place.point.x, found.place.point.u, "mean", found.place.condition.p)
    row, column = (path.model.state_index(name) for name in ("S_v", "S_h"))
    strongest = loops_through(a, row, column, 1j * found.frequency)[0]
    words = {state_words(path.model, k) for k in strongest.states}
    assert words == {"pitch rate", "pitch angle", "yaw rate"}
    # It is that of a model built with the value.
    for factor, stable in ((0.98, True), (1.02, False)):
        model = Newtonian(parameters={"k_g": factor * found.value})
        place = OperatingPath(model, {"alpha_v": 0.4}, "alpha_v").first(0.4, 0.4)
        assert (place.spectrum.values.real.max() < 0) == stable
    # It needs both couplings, in product.
    _, _, (over_k_m,) = locus({"alpha_v": 0.4}, "k_m", (0.0, 4e-4), model=RAHIDEH)
    product = over_k_m.value * RAHIDEH.parameters["k_g"].value
    assert product == pytest.approx(found.value * p["k_m"], rel=1e-6)


def test_the_lagrangian_form_has_no_such_instability():
    model = Lagrangian(parameter_set="rahideh")
    path, sweep, found = locus({}, "alpha_v", (-0.6, 0.94), points=31, model=model)
    assert found == () and sweep.eigenvalues.real.max() < 0
    # Its yaw moment depends on the pitch rate, which the Newtonian form's does not.
    for form, expected in ((model, -0.186), (RAHIDEH, 0.0)):
        path = OperatingPath(form, {}, "alpha_v")
        point = path.first(0.4, 0.4).point
        row, column = (form.state_index(name) for name in ("S_h", "S_v"))
        assert path.linear.a(point.x, point.u)[row, column] == pytest.approx(expected, abs=1e-3)


def test_gains_of_loops_are_those_of_masons_rule():
    # Two states in a ring: det(sI − A) = (s − a)(s − d)(1 − L), so L = 1 at an eigenvalue.
    a = np.array([[-1.0, 2.0], [-3.0, -0.5]])
    s = np.linalg.eigvals(a)[0]
    (loop,) = loops_through(a, 0, 1, s)
    assert loop.gain == pytest.approx(1.0)
    three = np.array([[-1.0, 0, 2.0], [0.5, -0.3, 0], [0, 1.5, -2.0]])
    (loop,) = loops_through(three, 0, 2, np.linalg.eigvals(three)[0])
    assert len(loop.states) == 3 and loop.gain == pytest.approx(1.0)


def test_the_map_has_the_boundary_of_the_loci_and_ends_where_there_is_no_operating_point():
    path = OperatingPath(Newtonian(), {"alpha_v": 0.4}, "k_g")
    found = stability_map(path, "alpha_v", RANGE, (0.3, 0.5), (7, 5), silent)
    assert found.largest_growth_1_s.shape == (5, 7)
    row = np.flatnonzero(np.isclose(found.boundary[:, 1], 0.4))
    assert found.boundary[row, 0] == pytest.approx([0.1481], abs=2e-4)
    assert np.all(np.diff(found.largest_growth_1_s, axis=1) > 0)  # more k_g, less stable
    path = OperatingPath(FeedbackManual(), {"alpha_v": -0.5}, "K_gy")
    found = stability_map(path, "alpha_v", (0.01, 0.05), (-0.4, 0.2), (3, 5), silent)
    assert np.isfinite(found.largest_growth_1_s[0]).all()
    assert np.isnan(found.largest_growth_1_s[-1]).all()
    asked = RootLocus(over="u_v", range=(1.5, 2.5), against="u_h", points=9, map_points=3)
    findings = answer(asked)
    values = findings.results["locus"]["values"]
    assert values[-1] == pytest.approx(2.23, abs=5e-3)
    assert "ends" in findings.results["locus"]["ended_high"]
    assert findings.results["map"]["along_against"][0]["over"] == 1.5


def test_the_study_says_where_and_why():
    findings = answer(RootLocus(points=21, map_points=5))
    assert "k_g = 0.14813" in findings.lead[0]
    assert findings.measures[1].value == pytest.approx(0.14813, rel=1e-4)
    sentences = " ".join(findings.lead)
    assert "pitch moment per yaw rate" in sentences
    assert "loop" in sentences
    results = findings.results
    assert results["crossings"][0]["kind"] == "Hopf"
    assert results["crossings_by_side"]["upper"][0] == pytest.approx(0.1413, abs=1e-3)
    (at_model, *_) = [e for e in results["map"]["along_against"] if e["over"] == 0.2]
    assert at_model["crossings"][0]["value"] == pytest.approx(0.347, abs=2e-3)
    drawn = {"root_locus", "root_locus_range", "root_locus_why", "root_locus_map"}
    assert {chart.name for chart in findings.charts} == drawn
    # Numbers have units.
    assert "At alpha_v = 0.4 rad the pitch swing" in sentences
    assert "unstable above alpha_v = 0.3468 rad" in sentences
    commands = answer(RootLocus(over="k_g", at={"u_v": 1.0}, points=5))
    assert "At u_v = 1 V, k_g" in commands.lead[0]


def test_where_nothing_crosses_the_lead_tells_the_closest_place_and_what_moves_nothing():
    findings = answer(RootLocus(points=41), Newtonian(freedom="horizontal"))
    sentences = " ".join(findings.lead)
    assert "does not move the growth rate" not in sentences
    assert "The tail rotor comes closest to the axis at alpha_h = 0 rad" in sentences
    assert "between −3.45 and −1.69 1/s" in sentences
    # The table of shares would be one of rounding.
    assert not [t for s in findings.sections if s.heading == "Why" for t in s.blocks[:-1]]
    # At an extreme rounding is no cause.
    findings = answer(RootLocus(points=21), QuanserAero())
    assert abs(findings.results["why"][0]["dlambda"][0]) < 1e-6
    sentences = " ".join(findings.lead)
    assert "comes closest to the axis at alpha_v = 0 rad" in sentences and "e-" not in sentences
    (why,) = [s for s in findings.sections if s.heading == "Why"]
    assert all(type(block).__name__ == "Chart" for block in why.blocks)
    # The cable's stiffness on the other side of the yaw.
    findings = answer(RootLocus(over="k_chp", at={"alpha_h": -0.3}, points=5))
    assert "k_chp moves no growth rate" in " ".join(findings.lead)
    assert findings.results["why"] == []


@pytest.mark.parametrize(
    ("parts", "moved"),
    [((1e-10,), False), ((-4.5e-32,), False), ((3e3, -3e3 + 1e-6), False), ((1e-3,), True)],
)
def test_what_cancels_but_for_rounding_moves_nothing(parts, moved):
    shares = tuple(EntryShare(0, k, 1.0, complex(part)) for k, part in enumerate(parts))
    total = complex(sum(parts))
    assert moves(Sensitivity(total, total, shares)) is moved


def test_the_chart_of_a_jump_breaks_its_curves_there():
    path = OperatingPath(Newtonian(freedom="horizontal"), {}, "alpha_h")
    sweep = sweep_eigenvalues(path, -1.0, 1.0, 41)
    tracks = tracks_of(path.model, sweep)
    rotor = next(t for t in tracks if t.name == "tail rotor")
    chart = share_chart("why", path, sweep, rotor.members[0], rotor.name)
    together = next(m for m in chart.panels[0].marks if getattr(m, "label", "") == "together")
    gaps = np.isnan(together.y)
    # At the jump itself, and where the derivative grows beyond bounds beside it.
    assert np.any(np.abs(sweep.values[gaps]) < 1e-9)
    assert np.all(np.abs(sweep.values[gaps]) < 0.01)
