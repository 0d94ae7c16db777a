"""Modes that become others along a range: what a crossing is called."""

from __future__ import annotations

import pytest

from trms_cli.models.newtonian import Newtonian
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
    told = " ".join(findings.sections[-1].text)
    assert "“yaw swing” is mostly of the pitch" in told
    # The same by the modes of a point beyond it, which know nothing of tracks.
    beyond = Local(at={"alpha_v": 1.0}, over="alpha_v", range=(0.99, 1.01), points=3)
    modes = {
        m["name"]: m for m in beyond.run(Subject(model, "rahideh"), silent).results["at"]["modes"]
    }
    assert modes["pitch divergence"]["real"] > 0 > modes["yaw swing"]["real"]
