"""What is varied and over which range: commands in `at`, clashes, reversed ranges."""

from __future__ import annotations

import pytest

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.newtonian import Newtonian
from trms_cli.stability.studies.controllability import Controllability
from trms_cli.stability.studies.local import Local
from trms_cli.stability.studies.root_locus import RootLocus
from trms_cli.stability.study import silent
from trms_cli.stability.subject import Subject

STUDIES = (Local, RootLocus, Controllability)
NEWTONIAN = Subject(Newtonian(), "newtonian")


@pytest.mark.parametrize("study", STUDIES)
@pytest.mark.parametrize("at", [{"u_v": 1.0}, {"u_v": 1.0, "u_h": 0.0}])
def test_the_first_command_in_at_is_varied_if_nothing_is_said(study, at):
    results = study(at=at, points=5, range=(0.5, 1.5)).run(NEWTONIAN, silent).results
    line = results["locus" if study is RootLocus else "range"]
    assert line["over"] == "u_v"
    assert line["values"][0] == 0.5 and line["values"][-1] == 1.5
    if study is not RootLocus:
        assert results["at"]["u"]["u_v"] == pytest.approx(1.0)


@pytest.mark.parametrize("study", STUDIES)
@pytest.mark.parametrize(
    ("at", "over", "says", "use"),
    [
        ({"u_v": 1.0}, "alpha_v", "over=alpha_v varies an angle; at holds commands", "u_v"),
        ({"alpha_v": 0.1}, "u_h", "over=u_h varies a command; at holds angles", "alpha_v"),
    ],
)
def test_a_line_that_does_not_go_with_at_is_refused_with_one_that_does(study, at, over, says, use):
    with pytest.raises(ConfigurationError) as refused:
        study(at=at, over=over, points=5).run(NEWTONIAN, silent)
    assert says in refused.value.problem
    assert f"study.over={use}" in refused.value.remedy


@pytest.mark.parametrize("study", STUDIES)
def test_a_reversed_range_is_refused(study):
    with pytest.raises(ConfigurationError, match="upper end comes first") as refused:
        study(over="alpha_v", range=(0.2, -0.2), points=5).run(NEWTONIAN, silent)
    assert "study.range=[-0.2,0.2]" in refused.value.remedy


def test_a_reversed_range_of_the_map_is_refused_by_its_own_name():
    asked = RootLocus(over="alpha_v", against="k_g", against_range=(0.2, 0.1), points=5)
    with pytest.raises(ConfigurationError) as refused:
        asked.run(NEWTONIAN, silent)
    assert "study.against_range=[0.1,0.2]" in refused.value.remedy
