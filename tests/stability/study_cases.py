"""Studies of a model alone, as the tests ask for them."""

from typing import Any

from trms_cli.core.findings import Findings
from trms_cli.models.newtonian import Newtonian
from trms_cli.stability.study import Study, silent
from trms_cli.stability.subject import Subject

NEWTONIAN = Newtonian()
#: The thesis's parameters of the same equations.
RAHIDEH = Newtonian(parameter_set="rahideh")


def answer(study: Study, model: Any = NEWTONIAN) -> Findings:
    return study.run(Subject(model, "tested"), silent)
