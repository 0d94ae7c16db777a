"""Files of linear models: a state space about an operating point, which ``model=PATH`` takes.

::

    name: subspace
    model: linear
    source: fitted to …                   # a line on how, and to what
    rig: newtonian                        # optional: option of configs/model that a run simulates
    limits: {u_v: 2.5, u_h: 2.5, alpha_v: 1.05, alpha_h: 2.8}
    state_space: {outputs: [alpha_v, …], sample_time: 0.02, A: [[…]], B: [[…]], …}
    training: {…}                         # optional: a record of the fit, with its uncertainties
    effects: {…}                          # optional, as in every model file

The state space is that of :mod:`trms_cli.models.state_space`; each output has a disturbance, an
acceleration. The noise that was estimated with the model is an observer's process noise. States
that only remember an output or a command are copies, as those of a network.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.models.black_box import (
    BlackBox,
    BlackBoxFile,
    check_file,
    common_entries,
    complaints_by_file,
    mapping_of,
)
from trms_cli.models.model import FloatArray, Signal
from trms_cli.models.parameters import read_named
from trms_cli.models.state_space import DiscreteStateSpace

#: Value of ``model`` in a file of a linear model.
KIND = "linear"


class StateSpaceModel(BlackBox):
    """A linear model about an operating point that steps from sample to sample.

    Raises ModelError if a limit names no input or angle.

    ``limits``: as :class:`trms_cli.models.black_box.BlackBox` takes them.
    """

    def __init__(
        self,
        state_space: DiscreteStateSpace,
        *,
        name: str = KIND,
        limits: Mapping[str, float] | None = None,
    ) -> None:
        self.state_space = s = state_space
        super().__init__(
            tuple(map(Signal, s.outputs, s.output_units)),
            tuple(map(Signal, s.inputs, s.input_units)),
            tuple(map(Signal, s.states, s.state_units)),
            s.sample_time,
            name=name,
            limits=limits,
        )

    def transition(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        s = self.state_space
        after = (
            ca.DM(s.operating_state)
            + ca.DM(s.A) @ (x - ca.DM(s.operating_state))
            + ca.DM(s.B) @ (u - ca.DM(s.operating_input))
            # sparse: which states a disturbance pushes tells an observer of what kind they are
            + ca.sparsify(ca.DM(s.E)) @ w
        )
        # What only remembers is written as a copy, which an observer knows from a state of its own.
        now, offset = ca.vertcat(x, u), np.concatenate([s.operating_state, s.operating_input])
        for row, slopes in enumerate(np.hstack([s.A, s.B])):
            [source, *others] = np.flatnonzero(slopes) if slopes.any() else [row, row]
            copied = row >= self.n_y and not others and slopes[source] == 1.0
            if copied and s.operating_state[row] == offset[source]:
                after[row] = now[source]
        return after

    def noise_sd(self, p: ca.SX, step: float) -> ca.SX:
        return ca.SX(ca.DM(self.state_space.noise_sd * np.sqrt(step / self.sample_time)))

    def rest(self) -> FloatArray:
        """Where the model settles without a command; the operating point where it settles nowhere.

        Far from the operating point a linear model only extrapolates.
        """
        s = self.state_space
        try:
            deviation = np.linalg.solve(np.eye(s.n_x) - s.A, -s.B @ s.operating_input)
        except np.linalg.LinAlgError:
            deviation = np.zeros(s.n_x)
        return np.asarray(s.operating_state + deviation)


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearFile(BlackBoxFile):
    """The content of a file of a linear model."""

    kind = KIND
    body = ("state_space",)

    state_space: DiscreteStateSpace

    def model(self) -> StateSpaceModel:
        """The model.

        Raises ModelError if a limit names no input or angle.
        """
        return StateSpaceModel(self.state_space, limits=self.limits)


def linear_of(content: LinearFile, path: str) -> StateSpaceModel:
    """The model of a file, with complaints by the file's keys."""
    with complaints_by_file(path):
        return content.model()


def read_linear_file(path: str, where: str = "model.path") -> LinearFile:
    """Read a linear model.

    Raises ConfigurationError if there is no such file. Raises ModelError if the content is not of
    the documented form; it names the file and the key.
    """
    file, text = read_named(path, where, "models", "linear model", "file of a linear model")
    data = mapping_of(file, text, "fit again: trms identify method=subspace real=FILE")
    check_file(data, path, LinearFile, "linear model")
    return LinearFile(
        state_space=DiscreteStateSpace.from_data(data["state_space"], f"{path}: state_space"),
        **common_entries(data, path),
    )
