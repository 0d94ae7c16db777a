"""What a root locus says: of kinks, of rounding, and with units."""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.models.newtonian import Newtonian
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.stability.local.sensitivity import EntryShare, Sensitivity, moves, share_chart
from trms_cli.stability.local.sweep import OperatingPath, swept
from trms_cli.stability.local.tracks import tracks_of
from trms_cli.stability.studies.root_locus import RootLocus
from trms_cli.stability.study import silent
from trms_cli.stability.subject import Subject


def test_at_a_kink_it_is_said_where_and_what_the_growth_rate_does_over_the_range():
    subject = Subject(Newtonian(freedom="horizontal"), "horizontal")
    findings = RootLocus(points=41).run(subject, silent)
    sentences = " ".join(findings.lead)
    assert "does not move the growth rate" not in sentences
    assert "The tail rotor comes closest to the axis at alpha_h = 0 rad" in sentences
    assert "between −3.45 and −1.69 1/s" in sentences
    # The table of shares would be one of rounding.
    assert not [t for s in findings.sections if s.heading == "Why" for t in s.blocks[:-1]]


def test_at_an_extreme_rounding_is_no_cause():
    findings = RootLocus(points=21).run(Subject(QuanserAero(), "quanser_aero"), silent)
    assert abs(findings.results["why"][0]["dlambda"][0]) < 1e-6
    sentences = " ".join(findings.lead)
    assert "comes closest to the axis at alpha_v = 0 rad" in sentences and "e-" not in sentences
    (why,) = [s for s in findings.sections if s.heading == "Why"]
    assert all(type(block).__name__ == "Chart" for block in why.blocks)


@pytest.mark.parametrize(
    ("parts", "moved"),
    [((1e-10,), False), ((-4.5e-32,), False), ((3e3, -3e3 + 1e-6), False), ((1e-3,), True)],
)
def test_what_cancels_but_for_rounding_moves_nothing(parts, moved):
    shares = tuple(EntryShare(0, k, 1.0, complex(part)) for k, part in enumerate(parts))
    total = complex(sum(parts))
    assert moves(Sensitivity(total, total, shares)) is moved


def test_a_number_that_moves_nothing_is_told_as_such():
    # The cable's stiffness on the other side of the yaw.
    model = Newtonian()
    findings = RootLocus(over="k_chp", at={"alpha_h": -0.3}, points=5).run(
        Subject(model, "newtonian"), silent
    )
    assert "k_chp moves no growth rate" in " ".join(findings.lead)
    assert findings.results["why"] == []


def test_the_chart_of_a_jump_breaks_its_curves_there():
    path = OperatingPath(Newtonian(freedom="horizontal"), {}, "alpha_h")
    sweep = swept(path, -1.0, 1.0, 41)
    tracks = tracks_of(path.model, sweep)
    rotor = next(t for t in tracks if t.name == "tail rotor")
    chart = share_chart("why", path, sweep, rotor.members[0], rotor.name)
    together = next(m for m in chart.panels[0].marks if getattr(m, "label", "") == "together")
    gaps = np.isnan(together.y)
    # At the jump itself, and where the derivative grows beyond bounds beside it.
    assert np.any(np.abs(sweep.values[gaps]) < 1e-9)
    assert np.all(np.abs(sweep.values[gaps]) < 0.01)


def test_numbers_have_units():
    findings = RootLocus(points=11, map_points=3).run(Subject(Newtonian(), "newtonian"), silent)
    sentences = " ".join(findings.lead)
    assert "At alpha_v = 0.4 rad the pitch swing" in sentences
    assert "unstable above alpha_v = 0.3468 rad" in sentences
    commands = RootLocus(over="k_g", at={"u_v": 1.0}, points=5).run(
        Subject(Newtonian(), "newtonian"), silent
    )
    assert "At u_v = 1 V, k_g" in commands.lead[0]
