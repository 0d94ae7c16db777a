"""Rigs of any model, many at once: its equations, with the laws of effects in code of their own.

Of the model are its derivative and what it measures, with the rig's own values of the parameters.
All else shares nothing with ``effects/`` but names and units of sizes: Heun's method with twenty
steps a sample, friction by bristles (LuGre), hysteresis by elastic slips (Iwan), delays in a
buffer, quantised, noisy, jittering sensors, and drives whose gain wanders. What no library has is
here, too (:data:`OUTSIDE`).
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np
import numpy.typing as npt

from experiments.gap.blind.parts import Bristles, DelayLine, Oscillator, Play, Slips
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.model import Model, names
from trms_cli.models.scales import scales_of

FloatArray = npt.NDArray[np.float64]

STEPS = 20  #: of the integration, in a sample
#: Laws by where they act, each with the size that makes it large: an effect is called
#: ``<port>_<law>``, a size ``<effect>.<size>``.
INPUT_LAWS: Mapping[str, str] = {
    "delay": "delay",
    "lag": "time_constant",
    "dead_zone": "width",
    "backlash": "width",
    "rate_limit": "rise_time",
    "gain_drift": "drift",
    "bias": "bias",
}
AXIS_LAWS: Mapping[str, str] = {
    "coulomb_friction": "torque",
    "stribeck_friction": "torque",
    "quadratic_damping": "coefficient",
    "stiffness": "stiffness",
    "hysteresis": "torque",
    "cogging": "sine",
    "disturbance": "torque",
}
OUTPUT_LAWS: Mapping[str, str] = {
    "bias": "bias",
    "scale": "error",
    "delay": "delay",
    "lag": "time_constant",
    "quantisation": "quantum",
    "flexible_mode": "share",
    "crosstalk": "share",
    "dropout": "share",
}
#: Laws that no library has: of inputs, axes, outputs.
OUTSIDE: tuple[Mapping[str, str], ...] = (
    {"early_limit": "cut"},
    {"one_sided_friction": "torque", "one_way_damping": "coefficient"},
    {"eccentricity": "amplitude"},
)
_SIZES = {
    law: size
    for laws in (INPUT_LAWS, AXIS_LAWS, OUTPUT_LAWS, *OUTSIDE)
    for law, size in laws.items()
}
#: Largest product of the bristles' eigenfrequency and the step: beyond it Heun's method trembles.
_STIFFEST = 0.5
_TURNS = 12.0  #: periods of an eccentric encoder over its range


def law_of(effect: str) -> str:
    """The law in an effect's name."""
    return max((law for law in _SIZES if effect.endswith(f"_{law}")), key=len, default="")


def growing_size(effect: str) -> str:
    """The size that makes an effect large."""
    return _SIZES[law_of(effect)]


class ModelRigs:
    """The state of n rigs during a run.

    Parameters
    ----------
    model : Model
    values : (n, n_p) array
        Parameters of each rig.
    sizes : dict of str to (n,) array
        Sizes of effects; what is not named is zero.
    nuisances : dict of str to (n,) array
        By the names of :func:`.model_set.draw_nuisances`.
    sample_time : float
        s.
    seed : int
        Of noise, jitter and wander.
    """

    def __init__(
        self,
        model: Model,
        values: FloatArray,
        sizes: Mapping[str, FloatArray],
        nuisances: Mapping[str, FloatArray],
        sample_time: float,
        seed: int | list[int],
    ) -> None:
        self._n, self._h, self._sizes, self._own = (
            len(values),
            sample_time / STEPS,
            sizes,
            nuisances,
        )
        self._model, self._random = model, np.random.default_rng(seed)
        self._none = np.zeros(self._n)
        self._rows = [model.state_index(axis.angle) for axis in model.axes.values()]
        moments = names(model.disturbances)
        self._moments = [moments.index(axis.moment) for axis in model.axes.values()]
        self._equations(model)
        self._p = np.ascontiguousarray(values.T)
        self.x = np.tile(model.rest()[:, None], self._n)
        self._before, self.time = self.x, 0.0
        self.u = np.zeros((model.n_u, self._n))
        self._limits = model.input_bounds()[1]
        self._inputs(model)
        self._axes(model)
        self._outputs(model)
        self._settle()

    def _size(self, effect: str, name: str) -> FloatArray:
        return self._sizes.get(f"{effect}.{name}", self._none)

    def _has(self, effect: str, name: str) -> FloatArray | None:
        values = self._sizes.get(f"{effect}.{name}")
        return values if values is not None and values.any() else None

    def _nuisance(self, name: str, usual: float = 0.0) -> FloatArray:
        return self._own.get(name, np.full(self._n, usual))

    def _equations(self, model: Model) -> None:
        """Derivative, rates of the axes and outputs, of all rigs in one call."""
        x, u, p, w = model.symbols()
        f = model.dynamics(x, u, p, w)
        rates = ca.vertcat(*(f[row] for row in self._rows))
        push = ca.jacobian(ca.jtimes(rates, x, f), w)
        own = [push[i, moment] for i, moment in enumerate(self._moments)]
        self._mobility = ca.Function("mobility", [x, u, p, w], [ca.vertcat(*own)])
        derivative = ca.Function("f", [x, u, p, w], [f]).map(self._n)
        seen = [rates, model.measurement(x, u, p)]
        self._f = BufferedFunction(derivative)
        self._seen = BufferedFunction(ca.Function("seen", [x, u, p, w], seen).map(self._n))

    def _shaped(self, function: BufferedFunction, x: FloatArray, w: FloatArray) -> list[FloatArray]:
        values = (x, self.u, self._p, w)
        for array, value in zip(function.inputs, values, strict=True):
            array[...] = value.reshape(array.shape)
        function()
        return [np.array(out).reshape(-1, self._n) for out in function.outputs]

    def _inputs(self, model: Model) -> None:
        self._in = names(model.inputs)
        longest = max((self._size(f"{i}_delay", "delay").max() for i in self._in), default=0.0)
        self._delays = [
            DelayLine(self._size(f"{i}_delay", "delay"), longest + 2 * self._h, self._h)
            for i in self._in
        ]
        k = len(self._in)
        self._lagged, self._slewed = np.zeros((k, self._n)), np.zeros((k, self._n))
        self._plays = [Play() for _ in self._in]
        self._phase = self._random.uniform(0, 2 * np.pi, (k, self._n))
        self._period = self._random.uniform(40.0, 200.0, (k, self._n))
        self._wander = self._random.standard_normal((k, self._n))

    def _axes(self, model: Model) -> None:
        self._axis_names = tuple(model.axes)
        zero = np.zeros(model.n_w)
        rest, still = model.rest(), np.zeros(model.n_u)
        mobility = np.array(
            [np.array(self._mobility(rest, still, p, zero)).ravel() for p in self._p.T]
        ).T
        self._travel = scales_of(model).travels
        self._friction, self._one_sided, self._slips = [], [], []
        for a, axis in enumerate(self._axis_names):
            inertia = 1 / np.maximum(np.abs(mobility[a]), 1e-12)
            coulomb, stribeck = f"{axis}_coulomb_friction", f"{axis}_stribeck_friction"
            torque = self._size(coulomb, "torque") + self._size(stribeck, "torque")
            velocity = self._size(stribeck, "velocity")
            part = Bristles(inertia, self._bend(axis, torque, inertia))
            part.shape(
                torque,
                self._size(stribeck, "excess") + self._nuisance("stick"),
                np.where(velocity > 0, velocity, 0.03 * self._travel[axis]),
            )
            self._friction.append(part)
            torque = self._size(f"{axis}_one_sided_friction", "torque")
            part = Bristles(inertia, self._bend(axis, torque, inertia))
            part.shape(torque, self._none, np.ones(self._n))
            self._one_sided.append(part)
            slips = Slips(self._nuisance("slip_spread", 1.0))
            hysteresis = f"{axis}_hysteresis"
            slips.shape(self._size(hysteresis, "torque"), self._size(hysteresis, "width"))
            self._slips.append(slips)
        self._push = np.zeros((len(self._axis_names), self._n))

    def _bend(self, axis: str, torque: FloatArray, inertia: FloatArray) -> FloatArray:
        """Where bristles slide: as drawn, but no stiffer than the steps can follow."""
        least = torque / inertia * (self._h / _STIFFEST) ** 2
        return np.maximum(self._nuisance(f"{axis}_bend", 1e-4 * self._travel[axis]), least)

    def _outputs(self, model: Model) -> None:
        self._out = names(model.outputs)
        longest = max((self._size(f"{o}_delay", "delay").max() for o in self._out), default=0.0)
        self._late = [
            DelayLine(self._size(f"{o}_delay", "delay"), longest + 2 * self._h, self._h)
            for o in self._out
        ]
        self._modes = [
            Oscillator(*(self._size(f"{o}_flexible_mode", s) for s in _MODE)) for o in self._out
        ]
        angles = [axis.angle for axis in model.axes.values()]
        self._axis_of = [angles.index(o) if o in angles else None for o in self._out]
        self._shown: FloatArray | None = None

    def _settle(self) -> None:
        rates, y = self._shaped(self._seen, self.x, np.zeros((self._model.n_w, self._n)))
        self._rates, self._y, self._y_before = rates, y, y
        self._slow = y.copy()
        for line, value in zip(self._late, y, strict=True):
            line.settle(value)

    def advance(self, command: FloatArray) -> None:
        """One sample on; ``command``: (n, n_u), in force from now."""
        time = np.maximum(self._nuisance("drift_time"), 1e-3)
        decay = np.exp(-STEPS * self._h / time)
        noise = self._random.standard_normal(self._wander.shape)
        self._wander = decay * self._wander + np.sqrt(1 - decay**2) * noise
        for _ in range(STEPS):
            self._step(command)

    def measure(self) -> FloatArray:
        """The sensors, a little early or late, (n, n_y)."""
        ago = np.abs(self._random.normal(0, 1, self._n)) * self._nuisance("jitter") / self._h
        y = self._y + np.clip(ago, 0, 1) * (self._y_before - self._y)
        shown = np.empty_like(y)
        for i, name in enumerate(self._out):
            value = self._late[i].read(y[i])
            value = np.where(self._size(f"{name}_lag", "time_constant") > 0, self._slow[i], value)
            share = self._has(f"{name}_crosstalk", "share")
            if share is not None:
                j = (i + 1) % len(self._out)
                value = value + share * y[j] * self._travel[name] / self._travel[self._out[j]]
            value = value * (1 + self._size(f"{name}_scale", "error"))
            value = value + self._size(f"{name}_bias", "bias") + self._nuisance(f"{name}_bias")
            amplitude = self._has(f"{name}_eccentricity", "amplitude")
            if amplitude is not None:
                value = value + amplitude * np.sin(_TURNS * value / self._travel[name])
            value = value + self._modes[i].angle_contribution
            noise = self._random.standard_normal(self._n)
            value = value + self._nuisance(f"{name}_noise") * noise
            step = np.maximum(
                self._size(f"{name}_quantisation", "quantum"), self._nuisance(f"{name}_quantum")
            )
            rounded = step * np.round(value / np.where(step > 0, step, 1.0))
            shown[i] = np.where(step > 0, rounded, value)
            lost = self._has(f"{name}_dropout", "share")
            if lost is not None and self._shown is not None:
                keeps = self._random.uniform(size=self._n) < lost
                shown[i] = np.where(keeps, self._shown[i], shown[i])
        self._shown = shown
        return shown.T.copy()

    def _step(self, command: FloatArray) -> None:
        h = self._h
        self.time += h
        self._drive(command)
        w = self._forces()
        (now,) = self._shaped(self._f, self.x, w)
        (then,) = self._shaped(self._f, self.x + h * now, w)
        self.x = self.x + h / 2 * (now + then)
        before = self._rates
        self._y_before = self._y
        self._rates, self._y = self._shaped(self._seen, self.x, w)
        for i, name in enumerate(self._out):
            self._late[i].push(self._y[i])
            lag = self._has(f"{name}_lag", "time_constant")
            if lag is not None:
                mean = (self._y[i] + self._y_before[i]) / 2
                self._slow[i] += (mean - self._slow[i]) * _share(h, lag)
            a = self._axis_of[i]
            if a is not None and self._has(f"{name}_flexible_mode", "share") is not None:
                self._modes[i].advance((self._rates[a] - before[a]) / h, h)

    def _drive(self, command: FloatArray) -> None:
        """From the command to what moves the rig."""
        for i, name in enumerate(self._in):
            u = command[:, i]
            self._delays[i].push(u)
            u = self._delays[i].read(u)
            lag = self._has(f"{name}_lag", "time_constant")
            if lag is not None:
                # its mean over the step: the value at either end is half a step off in time
                over = (self._lagged[i] - u) * _share(self._h, lag)
                self._lagged[i] -= over
                u = np.where(lag > 0, u + over * lag / self._h, u)
            width = self._has(f"{name}_backlash", "width")
            if width is not None:
                u = self._plays[i].follow(u, width)
            width = self._size(f"{name}_dead_zone", "width")
            u = u - np.clip(u, -width, width)
            cut = self._has(f"{name}_early_limit", "cut")
            if cut is not None:
                most = self._limits[i] / (1 + cut)
                u = np.clip(u, -most, most)
            rise = self._has(f"{name}_rate_limit", "rise_time")
            if rise is not None:
                most = np.where(rise > 0, self._limits[i] / np.maximum(rise, 1e-9), np.inf)
                change = np.clip(u - self._slewed[i], -most * self._h, most * self._h)
                u = np.where(rise > 0, self._slewed[i] + change / 2, u)
                self._slewed[i] += change
            drift, slow = (self._size(f"{name}_gain_drift", s) for s in ("drift", "time_constant"))
            if drift.any():
                u = u * (1 + drift * (1 - np.exp(-self.time / np.maximum(slow, 1e-6))))
            sine = np.sqrt(2) * np.sin(2 * np.pi * self.time / self._period[i] + self._phase[i])
            wander = np.where(self._nuisance("drift_time") > 0, self._wander[i], sine)
            u = u + self._size(f"{name}_bias", "bias")
            self.u[i] = u * (1 + self._nuisance("drift") * wander)

    def _forces(self) -> FloatArray:
        """What acts on the equations, constant over a step, (n_w, n)."""
        w = np.zeros((self._model.n_w, self._n))
        for a, axis in enumerate(self._axis_names):
            q, r = self.x[self._rows[a]], self._rates[a]
            force = -self._friction[a].torque(r, self._h)
            if self._has(f"{axis}_hysteresis", "torque") is not None:
                force = force - self._slips[a].torque(q)
            drag = self._has(f"{axis}_quadratic_damping", "coefficient")
            if drag is not None:
                force = force - drag * np.sign(r) * np.abs(r) ** self._nuisance("exponent", 2.0)
            stiffness, cubic, neutral = (
                self._size(f"{axis}_stiffness", s) for s in ("stiffness", "cubic", "neutral")
            )
            away = q - neutral
            force = force - stiffness * away - cubic * away**3
            sine, cosine, period = (
                self._size(f"{axis}_cogging", s) for s in ("sine", "cosine", "period")
            )
            if sine.any() or cosine.any():
                turn = 2 * np.pi * q / np.where(period > 0, period, 1.0)
                force = force - sine * np.sin(turn) - cosine * np.cos(turn)
            sd, time = (self._size(f"{axis}_disturbance", s) for s in ("torque", "time"))
            if sd.any():
                decay = np.exp(-self._h / np.maximum(time, 1e-3))
                noise = self._random.standard_normal(self._n)
                self._push[a] = decay * self._push[a] + sd * np.sqrt(1 - decay**2) * noise
                force = force + self._push[a]
            if self._has(f"{axis}_one_sided_friction", "torque") is not None:
                side = 1 / (1 + np.exp(np.clip(-q / (0.05 * self._travel[axis]), -50, 50)))
                force = force - side * self._one_sided[a].torque(r, self._h)
            force = force - self._size(f"{axis}_one_way_damping", "coefficient") * np.minimum(r, 0)
            w[self._moments[a]] += force
        return w


_MODE = ("share", "frequency", "damping")


def _share(step: float, time: FloatArray) -> FloatArray:
    """The part of the way that a first-order lag goes in a step."""
    way: FloatArray = 1 - np.exp(-step / np.maximum(time, 1e-9))
    return way
