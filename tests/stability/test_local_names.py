"""Modes that become others along a range: what a crossing is called."""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.core.chart import Line, Points
from trms_cli.models.newtonian import Newtonian
from trms_cli.stability.local.charts import colours_of, points_alone, styles_of
from trms_cli.stability.local.modes import EigenMode, Modes
from trms_cli.stability.local.stability_map import StabilityMap, map_section
from trms_cli.stability.local.sweep import OperatingPath
from trms_cli.stability.local.tracks import Track
from trms_cli.stability.studies.local import Local
from trms_cli.stability.study import silent
from trms_cli.stability.subject import Subject


def test_beyond_the_fold_it_is_the_pitch_that_diverges():
    model = Newtonian(parameter_set="rahideh")
    findings = Local(points=41).run(Subject(model, "rahideh"), silent)
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
    modes = {
        m["name"]: m for m in beyond.run(Subject(model, "rahideh"), silent).results["at"]["modes"]
    }
    assert modes["pitch divergence"]["real"] > 0 > modes["yaw swing"]["real"]


def test_no_two_modes_look_alike_in_a_figure():
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


def test_the_models_own_value_is_not_drawn_on_the_frame_of_a_map():
    def lines(span: tuple[float, float]) -> list[Line]:
        path = OperatingPath(Newtonian(), {"alpha_v": 0.4}, "k_g")
        over, against = np.linspace(*span, 3), np.array([0.3, 0.5])
        growth = np.array([[-0.1, 0.0, 0.1], [-0.1, 0.0, 0.2]])
        mapped = StabilityMap(over, against, growth, np.empty((0, 2)))
        (chart,) = map_section(path, "alpha_v", mapped, []).blocks
        return [mark for mark in chart.panels[0].marks if isinstance(mark, Line)]

    own = Newtonian().parameters["k_g"].value
    assert not lines((0.5 * own, own))
    (line,) = lines((0.5 * own, 2 * own))
    assert line.x == own and line.style == "dashed"
