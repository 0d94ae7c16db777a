"""The sentence of a diagnosis: what a colleague would say, and what he would not keep back."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from trms_cli.gap.diagnosis import Cause, Gap
from trms_cli.gap.free_runs import Shrinkage
from trms_cli.gap.summary import sentence


@pytest.mark.parametrize(("refit", "told"), [(0.002, False), (0.06, True)])
def test_parameters_that_do_not_hold_on_the_sealed_part_are_told(refit, told):
    gap = Gap(raw=0.1, refit=refit, corrected=refit, floor=0.0015, unit="rad")
    cause = Cause(effects=("parameters_only",), probability=0.94, parameters={})
    said = sentence(
        SimpleNamespace(verdict="parameters_only", confusable=()),  # type: ignore[arg-type]
        [cause],
        [],
        Shrinkage({"alpha_h": {"2.0": gap}}, {}, ()),
        {},
    )
    assert said.startswith("No effect is missing")
    assert ("40 times what the noise explains" in said) == told
