"""Measured motion of a recording beside what a model makes of it.

No fit and no free run: the rotors are driven by the recorded commands, and each axis is put where
it was measured, moving as it was measured to move. So the signs, units and places of the channels
can be told from a model that is only roughly right.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.dataset import Dataset
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model, RigAxis, names

#: s, window over which angles are differentiated twice.
_WINDOW = 0.5
#: s, longest integration step.
_STEP = 0.01
#: A slowly sampled recording is not worth a larger function: signs need no accuracy.
_MOST_SUBSTEPS = 8
#: Angles at which a function of one angle is evaluated before it is interpolated.
_GRID = 2000


@dataclass(frozen=True)
class RecordedMotion:
    """Measured and modelled motion of a dataset, on its time grid."""

    #: (n,) arrays; rotor speeds that the model gives for the recorded commands, by state, rad/s
    speeds: dict[str, FloatArray]
    #: dict of str to (n,) array; measured, by angle, rad/s²; NaN where it cannot be told
    accelerations: dict[str, FloatArray]
    #: dict of str to (n,) array; what the model gives with the axis' own rotor at rest, rad/s²
    passive: dict[str, FloatArray]
    thrust: dict[str, FloatArray]  #: dict of str to (n,) array; what its own rotor adds, rad/s²


class RecordedMotions:
    """Motions of datasets under one model.

    ``model``: with equations, angles that are states, and a torque on each axis. Raises ValueError
    for one of another kind; see :meth:`possible`.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        x, u, p, w = model.symbols()
        self._axes: dict[str, RigAxis] = {
            name: axis for name, axis in model.axes.items() if axis.angle in model.state_names
        }
        if model.sample_time is not None or not self._axes:
            raise ValueError(f"model {model.name!r} has no accelerations")
        angles = [model.state_index(axis.angle) for axis in self._axes.values()]
        f = model.dynamics(x, u, p, w)
        torques = [names(model.disturbances).index(a.moment) for a in self._axes.values()]
        pushed = ca.jacobian(f, ca.vertcat(*[w[i] for i in torques])).sparsity().T.get_triplet()[1]
        momenta = sorted({i for i in pushed if i not in angles})
        if len(momenta) != len(angles):
            raise ValueError(f"model {model.name!r} has no momentum for each axis")
        self._angles, self._momenta = angles, momenta
        #: By rotor: its speed, and the currents that drive it
        self._of_rotor: dict[str, list[int]] = {}
        for rotor, speed in model.rotor_speeds.items():
            row = model.state_index(speed)
            acts = ca.jacobian(f[row], x).sparsity().get_col()
            currents = [i for i in acts if model.states[i].unit == "A"]
            self._of_rotor[rotor] = [row, *currents]
        numbers = ca.DM(model.parameters.values)
        f = ca.substitute(ca.substitute(f, p, numbers), w, ca.DM.zeros(model.n_w))
        rates = ca.vertcat(*[f[i] for i in angles])
        momentum = ca.vertcat(*[x[i] for i in momenta])
        goal_rates = ca.SX.sym("rates", len(angles))
        slope = ca.densify(ca.jacobian(rates, momentum))
        still = ca.substitute(rates, momentum, ca.SX.zeros(len(momenta)))
        slope = ca.substitute(slope, momentum, ca.SX.zeros(len(momenta)))
        solved = ca.solve(slope, goal_rates - still)
        acceleration = ca.jtimes(rates, x, f)
        self._momentum_of = ca.Function("momentum", [x, u, goal_rates], [solved])
        self._acceleration = ca.Function("acceleration", [x, u], [acceleration])

    def at_rest(self, angle: str, values: FloatArray) -> FloatArray:
        """Acceleration with an axis held at angles, all else at rest and without commands.

        ``values``: (n,) array, rad. Returns (n,) array, rad/s²; of pitch, what weight alone makes.
        """
        if len(values) > _GRID:  # a smooth function of one angle
            grid = np.linspace(values.min(), values.max(), _GRID)
            return np.asarray(np.interp(values, grid, self.at_rest(angle, grid)))
        model, n = self.model, len(values)
        states = np.tile(model.rest()[:, None], (1, n))
        states[model.state_index(angle)] = values
        u, still = np.zeros((model.n_u, n)), np.zeros((len(self._angles), n))
        states[self._momenta] = self._mapped(self._momentum_of, states, u, still)
        return self._mapped(self._acceleration, states, u)[
            [axis.angle for axis in self._axes.values()].index(angle)
        ]

    @staticmethod
    def possible(model: Model) -> RecordedMotions | None:
        """For a model of the right kind; None for one that only steps or has no axes."""
        try:
            return RecordedMotions(model)
        except ValueError:
            return None

    def of(self, dataset: Dataset) -> RecordedMotion:
        """The motion of a dataset, which has the model's inputs in the model's order."""
        model, n = self.model, len(dataset)
        angle = np.tile(model.rest()[self._angles], (n, 1))
        rate, measured = np.zeros_like(angle), {}
        for i, axis in enumerate(self._axes.values()):
            if axis.angle in names(dataset.outputs):
                value, first, second = _derivatives(dataset.output(axis.angle), dataset.sample_time)
                angle[:, i], rate[:, i] = value, first
                measured[axis.angle] = second
        states = self._driven_states(dataset, angle, rate)
        u = dataset.commands.T
        # Momenta belong to the rotor speeds that are used.
        states[self._momenta] = self._mapped(self._momentum_of, states, u, rate.T)
        whole = self._mapped(self._acceleration, states, u)
        passive, thrust = {}, {}
        for i, (name, axis) in enumerate(self._axes.items()):
            if axis.angle not in measured:
                continue
            at_rest, silent = states.copy(), u.copy()
            rotor = model.rotor_of(name)
            if rotor is not None:
                own = model.rotors[rotor]
                for row in self._of_rotor.get(rotor, ()):
                    at_rest[row] = 0.0
                silent[names(model.inputs).index(own.input)] = 0.0
            at_rest[self._momenta] = self._mapped(self._momentum_of, at_rest, silent, rate.T)
            without = self._mapped(self._acceleration, at_rest, silent)[i]
            passive[axis.angle], thrust[axis.angle] = without, whole[i] - without
        modelled = {
            speed: states[model.state_index(speed)] for speed in model.rotor_speeds.values()
        }
        return RecordedMotion(modelled, measured, passive, thrust)

    def _driven_states(self, dataset: Dataset, angle: FloatArray, rate: FloatArray) -> FloatArray:
        """States (n_x, n) with the rotors simulated and the axes where they were measured."""
        model = self.model
        substeps = min(max(1, round(dataset.sample_time / _STEP)), _MOST_SUBSTEPS)
        discrete = discretise(model, dataset.sample_time, substeps)
        z, u = ca.SX.sym("z", discrete.n_x), ca.SX.sym("u", model.n_u)
        axes, rates = ca.SX.sym("axes", len(self._angles)), ca.SX.sym("rates", len(self._angles))
        placed = ca.SX(z)
        for column, row in enumerate(self._angles):
            placed[row] = axes[column]
        momentum = self._momentum_of(placed[: model.n_x], u, rates)
        for column, row in enumerate(self._momenta):
            placed[row] = momentum[column]
        after = discrete.step(placed, u, ca.DM(model.parameters.values), ca.DM.zeros(model.n_w))
        step = ca.Function("driven", [z, ca.vertcat(u, axes, rates)], [after])
        start = discrete.initial(self._start(dataset), dataset.commands[0])
        table = np.hstack([dataset.commands, angle, rate]).T
        n = table.shape[1]
        later = np.asarray(step.mapaccum(n - 1)(start, table[:, :-1])) if n > 1 else start[:, None]
        states = np.column_stack([start, later])[: model.n_x]
        states[self._angles] = angle.T
        return states

    def _start(self, dataset: Dataset) -> FloatArray:
        """Rest, with the first measured rotor speeds."""
        start = self.model.rest().copy()
        for speed in self.model.rotor_speeds.values():
            if speed in names(dataset.outputs):
                values = dataset.output(speed)
                finite = values[np.isfinite(values)]
                if len(finite):
                    start[self.model.state_index(speed)] = finite[0]
        return start

    @staticmethod
    def _mapped(function: ca.Function, *arguments: FloatArray) -> FloatArray:
        return np.asarray(function.map(arguments[0].shape[1])(*arguments))


def _derivatives(values: FloatArray, step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """An angle, its rate and its acceleration; the last NaN near an end or a missing sample."""
    there = np.isfinite(values)
    if not there.any():
        return (np.zeros_like(values),) * 2 + (np.full_like(values, np.nan),)
    at = np.arange(len(values))
    filled = np.interp(at, at[there], values[there])
    window = _window(step)
    if len(values) < window:
        return filled, np.zeros_like(values), np.full_like(values, np.nan)
    smooth, first, second = _local_cubics(filled, window, step)
    unsure = np.convolve(~there, np.ones(window), mode="same") > 0.5
    unsure[: window // 2] = unsure[len(unsure) - window // 2 :] = True
    return smooth, first, np.where(unsure, np.nan, second)


def smooth_motion(values: FloatArray, step: float) -> FloatArray:
    """Seen through the window through which the measured accelerations are seen, shape (n,)."""
    window = _window(step)
    if len(values) < window:
        return np.asarray(values)
    return _local_cubics(values, window, step)[0]


def _local_cubics(
    values: FloatArray, window: int, step: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Value, rate and acceleration of the cubic that fits best around each sample, (n,) arrays.

    Savitzky and Golay 1964, Analytical Chemistry 36; near an end those of the last whole window.
    ``scipy.signal`` has it, and takes longer to import than a check may take.
    """
    from numpy.polynomial.polynomial import polyder, polyval

    half = window // 2
    powers = np.arange(4)
    at = (np.arange(window) - half) * step
    fit = np.linalg.pinv(at[:, None] ** powers)  # (4, window): samples to coefficients
    derivatives = []
    for order, factor in ((0, 1.0), (1, 1.0), (2, 2.0)):
        inner = factor * np.convolve(values, fit[order][::-1], mode="same")
        for end, whole in (
            (slice(None, half), values[:window]),
            (slice(-half, None), values[-window:]),
        ):
            inner[end] = polyval(at[end], polyder(fit @ whole, order))
        derivatives.append(inner)
    return derivatives[0], derivatives[1], derivatives[2]


def _window(step: float) -> int:
    return max(7, 2 * round(_WINDOW / step / 2) + 1)
