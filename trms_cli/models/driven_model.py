"""A model with some of its states prescribed by measurements.

The beam of a rig driven by its measured rotor speeds can be fitted and judged without the errors
of a rotor model. A prescribed state becomes an input; its own equation is dropped, and what only
acted on it (its motor's disturbance) no longer acts on anything.
"""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from trms_cli.core.errors import ModelError
from trms_cli.models.model import FloatArray, Model, Signal, Window, index_of, names


class DrivenModel(Model):
    """A model whose states ``driven`` are inputs, after the inputs that it has.

    Raises ModelError for a name that is no measured state, or when no state would be left.

    ``driven``: measured states, such as ``omega_v`` and ``omega_h``.
    """

    def __init__(self, base: Model, driven: Sequence[str]) -> None:
        for name in driven:
            index_of(base.states, name, f"a state of model {base.name!r}")
            index_of(base.outputs, name, f"an output of model {base.name!r}")
        self.base = base
        self.driven_states = tuple(driven)
        self._state_rows = [i for i, name in enumerate(base.state_names) if name not in driven]
        self._place = [base.state_index(name) for name in driven]
        self._outputs = [i for i, name in enumerate(names(base.outputs)) if name not in driven]
        if not self._outputs:
            raise ModelError(
                f"nothing that model {base.name!r} measures is left to predict",
                where="driven",
                remedy=f"drive it by fewer of {', '.join(driven)}",
            )
        self.take_over(base)
        self.states = tuple(base.states[i] for i in self._state_rows)
        self.inputs = (*base.inputs, *(base.states[i] for i in self._place))
        self.outputs = tuple(base.outputs[i] for i in self._outputs)
        self.controlled = tuple(name for name in base.controlled if name not in driven)
        self.input_limits = dict(base.input_limits) | dict.fromkeys(driven, np.inf)

    def rest(self) -> FloatArray:
        return self.base.rest()[self._state_rows]

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        return self.base.dynamics(self._whole(x, u), u[: self.base.n_u, 0], p, w)[self._state_rows]

    def transition(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        return self.base.transition(self._whole(x, u), u[: self.base.n_u, 0], p, w)[
            self._state_rows
        ]

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        y = self.base.measurement(self._whole(x, u), u[: self.base.n_u, 0], p)
        return y[self._outputs]

    def quantities(self, x: ca.SX, u: ca.SX, p: ca.SX) -> dict[str, ca.SX]:
        return self.base.quantities(self._whole(x, u), u[: self.base.n_u, 0], p)

    def memory(self, step: float) -> tuple[Signal, ...]:
        return self.base.memory(step)

    def input_path(
        self, memory: ca.SX, u: ca.SX, p: ca.SX, window: Window, step: float
    ) -> tuple[ca.SX, ca.SX]:
        n = self.base.n_u
        arriving, memory = self.base.input_path(memory, u[:n, 0], p, window, step)
        return ca.vertcat(arriving, u[n:, 0]), memory

    def impulse(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX, duration: float) -> ca.SX:
        after = self.base.impulse(self._whole(x, u), u[: self.base.n_u, 0], p, w, duration)
        return after[self._state_rows]

    def sensor_memory(self, step: float) -> tuple[Signal, ...]:
        return self.base.sensor_memory(step)

    def sensor_path(
        self,
        memory: ca.SX,
        before: ca.SX,
        after: ca.SX,
        u: ca.SX,
        p: ca.SX,
        window: Window,
        step: float,
    ) -> ca.SX:
        first, last = self._whole(before, u), self._whole(after, u)
        own = u[: self.base.n_u, 0]
        return self.base.sensor_path(memory, first, last, own, p, window, step)

    def reading(
        self, memory: ca.SX, x: ca.SX, u: ca.SX, p: ca.SX, step: float, since: float = 1.0
    ) -> ca.SX:
        own = u[: self.base.n_u, 0]
        return self.base.reading(memory, self._whole(x, u), own, p, step, since)[self._outputs]

    def noise_sd(self, p: ca.SX, step: float) -> ca.SX:
        return self.base.noise_sd(p, step)[self._state_rows]

    def _whole(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """The base model's states from those left and the prescribed inputs."""
        whole = ca.SX.zeros(self.base.n_x)
        for i, row in enumerate(self._state_rows):
            whole[row] = x[i]
        for i, row in enumerate(self._place):
            whole[row] = u[self.base.n_u + i]
        return whole
