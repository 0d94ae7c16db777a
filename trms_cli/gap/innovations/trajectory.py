"""A model linearised along the trajectory of a recording, window by window."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.compilation import BufferedFunction
from trms_cli.identification.greybox.windows import Windows
from trms_cli.models.discretisation import discretise
from trms_cli.simulation.rollout import LONGEST_STEP

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Trajectory:
    """States and slopes at every sample of every window."""

    #: (m, c, n) array; the model's states and its memory; past the end of a short window they stay
    #: as they were
    x: FloatArray
    y: FloatArray  #: (m, c, n_y) array; what the sensors would read
    a: FloatArray  #: (m, c, n, n) array; ∂x⁺/∂x
    b: FloatArray  #: (m, c, n, n_u) array; ∂x⁺/∂u
    g: FloatArray  #: (m, c, n, n_w) array; ∂x⁺/∂w
    h: FloatArray  #: (m, c, n_y, n) array; ∂y/∂x


class Linearisation:
    """Simulates and linearises the model of some windows.

    Parameters
    ----------
    windows : Windows
        Of the model and the recordings.
    """

    def __init__(self, windows: Windows) -> None:
        self.windows = windows
        model = windows.problem.model
        step_length = windows.sample_time
        substeps = 1
        if model.sample_time is None:
            substeps = int(np.ceil(step_length / LONGEST_STEP - 1e-9))
        discrete = discretise(model, step_length, substeps, sensors=True)
        x, u, p, w = discrete.symbols()
        after, y = discrete.step(x, u, p, w), discrete.measurement(x, u, p)
        slopes = [ca.densify(ca.jacobian(after, v)) for v in (x, u, w)]
        self._step = BufferedFunction(
            ca.Function("gap_step", [x, u, p, w], ca.cse([after, *slopes]))
        )
        in_x = ca.densify(ca.jacobian(y, x))
        self._measure = BufferedFunction(ca.Function("gap_measure", [x, u, p], ca.cse([y, in_x])))
        self._none = np.zeros(model.n_w)

    def along(self, p: FloatArray, starts: FloatArray) -> Trajectory:
        """Along the model's own simulation from some starts.

        Parameters
        ----------
        p : (n_p,) array
        starts : (m, n_x) array
            Of the model's states; its memory is that of the commands before.
        """
        full = self.windows.with_memory(p, starts)
        m, c = self.windows.measured.shape[:2]
        trajectory = self._empty(m, c)
        for j in range(m):
            x = full[j].copy()
            for k in range(c):
                x = self._at(trajectory, j, k, x, p)
        return trajectory

    def through(self, p: FloatArray, x: FloatArray) -> Trajectory:
        """Through states that are given, (m, c, n), as a smoother gives them."""
        m, c = x.shape[:2]
        trajectory = self._empty(m, c)
        for j in range(m):
            for k in range(c):
                self._at(trajectory, j, k, x[j, k], p)
        return trajectory

    def _at(
        self, trajectory: Trajectory, j: int, k: int, x: FloatArray, p: FloatArray
    ) -> FloatArray:
        """Evaluate at one sample; the state after it."""
        u = self.windows.command(j, k)
        trajectory.x[j, k] = x
        y, h = self._measure.evaluate(x, u, p)
        after, a, b, g = self._step.evaluate(x, u, p, self._none)
        for name, value in (("y", y), ("h", h), ("a", a), ("b", b), ("g", g)):
            place = getattr(trajectory, name)[j, k]
            place[...] = np.reshape(value, place.shape)  # one input or output comes without axis
        return after.copy() if k + 1 < self.windows.count[j] else x

    def _empty(self, m: int, c: int) -> Trajectory:
        model, n = self.windows.problem.model, self.windows.rollout.n_x
        sizes = ((n,), (model.n_y,), (n, n), (n, model.n_u), (n, model.n_w), (model.n_y, n))
        return Trajectory(*(np.zeros((m, c, *size)) for size in sizes))
