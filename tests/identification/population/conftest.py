"""A short recording of a vertical rig whose parameters are known."""

from dataclasses import dataclass

import numpy as np
import pytest

from tests.identification.greybox.rigs import dataset_of
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.problem import FitProblem, free_parameters
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.simulation.rollout import Rollout

#: Found from pitch and the rotor's speed, each by itself.
FREE = ("k_fvp", "k_ov", "J_mr")
NOISE = {"alpha_v": 5e-4, "omega_v": 1.6}


@dataclass(frozen=True)
class Rig:
    """A model, a recording of a rig of other values, and these."""

    model: Model
    dataset: Dataset
    true: dict[str, float]

    def problem(self, **changes) -> FitProblem:
        free = free_parameters(self.model.parameters, FREE)
        known = {"datasets": (self.dataset,), "free": free, "window_length": 5.0, "jobs": 1}
        return FitProblem(model=self.model, **{**known, **changes})


@pytest.fixture(scope="session")
def rig() -> Rig:
    model = Newtonian(freedom="vertical")
    factors = {"k_fvp": 1.05, "k_ov": 1.3, "J_mr": 0.93}
    true = {name: factor * model.parameters[name].value for name, factor in factors.items()}
    step, n = 0.02, 1000
    rollout = Rollout(model, step)
    generator = np.random.default_rng(3)
    commands = np.repeat(generator.uniform(0.2, 1.6, n // 50), 50)[:, None]
    start = rollout.initial(model.rest(), np.zeros(1))
    p = model.parameters.replaced(true).values
    y = rollout.outputs(commands, [0], [n], start[None], p).y
    sd = np.array([NOISE[signal.name] for signal in model.outputs])
    measured = y + sd * generator.standard_normal(y.shape)
    return Rig(model, dataset_of(model, commands, measured, sd, step=step), true)
