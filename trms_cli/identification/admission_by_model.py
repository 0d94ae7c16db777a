"""Signs, units and places of channels, told by what a model makes of the recorded motion.

A rotor's speed must follow its command, and an axis' acceleration its rotor's thrust, with the
sign that the model gives. How much is left to chance: a channel is only called wrong where the
measurement is explained well the other way round.

No fit and no free run: the rotors are driven by the recorded commands, and each axis is put where
it was measured, moving as it was measured to move. So the signs, units and places of the channels
can be told from a model that is only roughly right.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import RecordingError
from trms_cli.identification.dataset import Dataset
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model, RigAxis, names

#: s, window over which angles are differentiated twice.
_WINDOW = 0.5
#: s, longest integration step.
_STEP = 0.01
#: A slowly sampled recording is not worth a larger function: signs need no accuracy.
_MOST_SUBSTEPS = 8
#: RigAxis and speed that belong to a rotor.
_OF_ROTOR = {"main": ("pitch", "omega_v"), "tail": ("yaw", "omega_h")}


@dataclass(frozen=True)
class RecordedMotion:
    """Measured and modelled motion of a dataset, on its time grid."""

    #: dict of str to (n,) array; rotor speeds that the model gives for the recorded commands, by
    #: state, rad/s
    speeds: dict[str, FloatArray]
    #: dict of str to (n,) array; measured, by angle, rad/s²; NaN where it cannot be told
    accelerations: dict[str, FloatArray]
    #: dict of str to (n,) array; what the model gives with the axis' own rotor at rest, rad/s²
    passive: dict[str, FloatArray]
    thrust: dict[str, FloatArray]  #: dict of str to (n,) array; what its own rotor adds, rad/s²


class RecordedMotions:
    """Motions of datasets under one model.

    Parameters
    ----------
    model : Model
        With equations, angles that are states, and a torque on each axis.

    Raises
    ------
    ValueError
        If the model is of another kind; see :meth:`possible`.
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
        numbers = ca.DM(model.parameters.values)
        f = ca.substitute(ca.substitute(f, p, numbers), w, ca.DM.zeros(model.n_w))
        rates = ca.vertcat(*[f[i] for i in angles])
        momentum = ca.vertcat(*[x[i] for i in momenta])
        wanted = ca.SX.sym("rates", len(angles))
        slope = ca.densify(ca.jacobian(rates, momentum))
        still = ca.substitute(rates, momentum, ca.SX.zeros(len(momenta)))
        slope = ca.substitute(slope, momentum, ca.SX.zeros(len(momenta)))
        solved = ca.solve(slope, wanted - still)
        acceleration = ca.jtimes(rates, x, f)
        self._momentum_of = ca.Function("momentum", [x, u, wanted], [solved])
        self._acceleration = ca.Function("acceleration", [x, u], [acceleration])

    def at_rest(self, angle: str, values: FloatArray) -> FloatArray:
        """Acceleration with an axis held at angles, all else at rest and without commands.

        Parameters
        ----------
        angle : str
            One that is a state of the model.
        values : (n,) array
            rad.

        Returns
        -------
        (n,) array
            rad/s²; of pitch, what weight alone makes of it.
        """
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

    def of(self, dataset: Dataset, speeds: dict[str, FloatArray] | None = None) -> RecordedMotion:
        """The motion of a dataset.

        ``dataset``: with the model's inputs in the model's order. ``speeds``: dict of str to (n,)
        array; measured rotor speeds that take the place of the modelled ones.
        """
        model, n = self.model, len(dataset)
        angle = np.tile(model.rest()[self._angles], (n, 1))
        rate, measured = np.zeros_like(angle), {}
        for i, axis in enumerate(self._axes.values()):
            if axis.angle in names(dataset.outputs):
                value, first, second = _derivatives(dataset.output(axis.angle), dataset.sample_time)
                angle[:, i], rate[:, i] = value, first
                measured[axis.angle] = second
        states = self._driven(dataset, angle, rate)
        given = speeds or {}
        for name in given:
            states[model.state_index(name)] = given[name]
        u = dataset.commands.T
        # Momenta belong to the rotor speeds that are used.
        states[self._momenta] = self._mapped(self._momentum_of, states, u, rate.T)
        whole = self._mapped(self._acceleration, states, u)
        passive, thrust = {}, {}
        rotor_of = {axis: name for name, (axis, _) in _OF_ROTOR.items()}
        for i, (name, axis) in enumerate(self._axes.items()):
            if axis.angle not in measured:
                continue
            rotor = rotor_of.get(name, "")
            at_rest, silent = states.copy(), u.copy()
            speed = _OF_ROTOR[rotor][1] if rotor else ""
            suffix = speed[-2:]
            for state in (speed, f"i{suffix}"):
                if state in model.state_names:
                    at_rest[model.state_index(state)] = 0.0
            if model.rotors.get(rotor) in names(model.inputs):
                silent[names(model.inputs).index(model.rotors[rotor])] = 0.0
            at_rest[self._momenta] = self._mapped(self._momentum_of, at_rest, silent, rate.T)
            without = self._mapped(self._acceleration, at_rest, silent)[i]
            passive[axis.angle], thrust[axis.angle] = without, whole[i] - without
        modelled = {
            speed: states[model.state_index(speed)]
            for _, speed in _OF_ROTOR.values()
            if speed in model.state_names
        }
        return RecordedMotion(modelled, measured, passive, thrust)

    def _driven(self, dataset: Dataset, angle: FloatArray, rate: FloatArray) -> FloatArray:
        """States (n_x, n) with the rotors simulated and the axes where they were measured."""
        model = self.model
        substeps = min(max(1, round(dataset.sample_time / _STEP)), _MOST_SUBSTEPS)
        discrete = discretise(model, dataset.sample_time, substeps)
        z, u = ca.SX.sym("z", discrete.n_x), ca.SX.sym("u", model.n_u)
        axes, rates = ca.SX.sym("axes", len(self._angles)), ca.SX.sym("rates", len(self._angles))
        placed = ca.SX(z)
        for row, column in zip(self._angles, range(len(self._angles)), strict=True):
            placed[row] = axes[column]
        momentum = self._momentum_of(placed[: model.n_x], u, rates)
        for row, column in zip(self._momenta, range(len(self._momenta)), strict=True):
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
        for _, speed in _OF_ROTOR.values():
            if speed in names(dataset.outputs) and speed in self.model.state_names:
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
    from scipy.ndimage import binary_dilation
    from scipy.signal import savgol_filter

    there = np.isfinite(values)
    if not there.any():
        return (np.zeros_like(values),) * 2 + (np.full_like(values, np.nan),)
    at = np.arange(len(values))
    filled = np.interp(at, at[there], values[there])
    window = max(7, 2 * round(_WINDOW / step / 2) + 1)
    if len(values) < window:
        return filled, np.zeros_like(values), np.full_like(values, np.nan)
    smooth, first, second = (
        savgol_filter(filled, window, 3, deriv=order, delta=step) for order in (0, 1, 2)
    )
    unsure = binary_dilation(~there, iterations=window // 2)
    unsure[: window // 2] = unsure[len(unsure) - window // 2 :] = True
    return smooth, first, np.where(unsure, np.nan, second)


def smoothed(values: FloatArray, step: float) -> FloatArray:
    """Seen through the window through which the measured accelerations are seen, shape (n,)."""
    from scipy.signal import savgol_filter

    window = max(7, 2 * round(_WINDOW / step / 2) + 1)
    if len(values) < window:
        return np.asarray(values)
    return np.asarray(savgol_filter(values, window, 3))


#: Correlation of a speed with what the command makes of it: clear, and none.
_CLEAR, _NONE = 0.6, 0.4
#: rpm in one rad/s, and what ratio counts as that.
_RPM, _RPM_SPREAD = 60 / (2 * np.pi), 2.0
_DEGREES, _DEGREES_SPREAD = 180 / np.pi, 2.5
#: Ratios of a rotor's speed to the model's within which a model is roughly right.
_ROUGHLY = 2.5
#: Share of the acceleration's variance that a thrust explains: clear, and little.
_EXPLAINS, _LITTLE = 0.3, 0.15
#: By how much a swapped reading must explain more.
_BETTER = 0.3
#: rad/s of the model's speed below which a rotor is at rest.
_TURNS = 5.0
#: 1/s: faster modes are armature currents, slower ones integrate.
_FASTEST_MODE, _SLOWEST_MODE = 100.0, 0.02
_LEAST_SAMPLES = 100
#: rad by which pitch may be off the model's: counterweights of the priors move rest by some 0.1.
_OFF_PITCH = 0.25
#: Zeros of pitch that are looked for, rad, and how finely.
_FARTHEST_ZERO, _ZERO_STEP = 1.5, 0.01
#: Share of the squared error of the acceleration that another zero must take away.
_ZERO_EXPLAINS = 0.5
#: Samples of a recording on which weight is evaluated.
_SPARSE = 1000


@dataclass(frozen=True)
class AdmissionCheck:
    """A channel that does not fit the model."""

    check: str
    channel: str
    problem: str
    remedy: str
    certain: bool  #: Whether the recording explains itself well the other way round


@dataclass(frozen=True)
class TimeScales:
    """Periods of a model's slowest and fastest mode, s (2π over the pole's distance from 0)."""

    slowest: float
    fastest: float


@dataclass(frozen=True)
class _Thrust:
    """How an axis answers to its rotor: ``α̈ = a·passive + b·thrust + c``."""

    factor: float  #: b
    share: float  #: of what the rest leaves, that the thrust explains
    explained: float  #: of the acceleration's variance, by all


def findings_by_model(dataset: Dataset, model: Model) -> list[AdmissionCheck]:
    """What does not fit; empty where the model has no accelerations or the data are too few."""
    motions = RecordedMotions.possible(model)
    if motions is None or len(dataset) < _LEAST_SAMPLES:
        return []
    motion = motions.of(dataset)
    thrusts = _thrusts(dataset, motion)
    swapped = list(_swapped(dataset, motions, motion, thrusts))
    if swapped:
        return swapped
    speeds = list(_speeds(dataset, motion))
    told = {finding.channel[-2:] for finding in speeds}
    found = [*speeds, *_angles(dataset, motions, thrusts, told)]
    return found or list(_zero(dataset, motions, motion))


def time_scales(dataset: Dataset, model: Model) -> TimeScales | None:
    """From the model's poles where the recording is on average; None for a black box."""
    if model.sample_time is not None:
        return None
    x, u, p, w = model.symbols()
    slope = ca.Function("slope", [x, u, p, w], [ca.jacobian(model.dynamics(x, u, p, w), x)])
    point = model.rest().copy()
    for i, signal in enumerate(dataset.outputs):
        values = dataset.measurements[:, i]
        if signal.name in model.state_names and np.isfinite(values).any():
            size = values if signal.unit == "rad" else np.abs(values)
            point[model.state_index(signal.name)] = float(np.nanmean(size))
    command = dataset.commands.mean(axis=0)
    a = np.asarray(slope(point, command, model.parameters.values, np.zeros(model.n_w)))
    if not np.isfinite(a).all():
        return None
    sizes = np.abs(np.linalg.eigvals(a))
    sizes = sizes[(sizes > _SLOWEST_MODE) & (sizes < _FASTEST_MODE)]
    if not len(sizes):
        return None
    return TimeScales(2 * np.pi / float(sizes.min()), 2 * np.pi / float(sizes.max()))


def _speeds(dataset: Dataset, motion: RecordedMotion) -> Iterator[AdmissionCheck]:
    for name, (correlation, ratio) in _followed(dataset, motion).items():
        command = f"u{name[-2:]}"
        if abs(correlation) < _NONE:
            yield AdmissionCheck(
                "speed", name, f"{name} does not follow {command} (correlation {correlation:.2f})",
                "look at which channel is which, and at the tacho", False,
            )  # fmt: skip
        elif correlation < -_CLEAR:
            yield AdmissionCheck(
                "sign", name, f"{name} turns the other way than {command} makes it turn",
                f"one of the two has the wrong sign: turn round {name} or {command} in the file",
                True,
            )  # fmt: skip
        elif correlation > _CLEAR and _near(ratio, _RPM, _RPM_SPREAD):
            yield AdmissionCheck(
                "unit", name,
                f"{name} is {ratio:.3g} times what {command} makes of it: rpm read as rad/s",
                f"write the unit into the header: {name}[rpm]", True,
            )  # fmt: skip
        elif correlation > _CLEAR and _near(ratio, 1 / _RPM, _RPM_SPREAD):
            yield AdmissionCheck(
                "unit", name,
                f"{name} is {ratio:.3g} times what {command} makes of it: rad/s read as rpm",
                f"write the unit into the header: {name}[rad/s]", True,
            )  # fmt: skip
        elif correlation > _CLEAR and not 1 / _ROUGHLY < ratio < _ROUGHLY:
            yield AdmissionCheck(
                "unit", name, f"{name} is {ratio:.2g} times what the model makes of {command}",
                f"is the model that of this rig? Are the units of {name} and {command} right?",
                False,
            )  # fmt: skip


def _angles(
    dataset: Dataset, motions: RecordedMotions, thrusts: dict[str, _Thrust], told: set[str]
) -> Iterator[AdmissionCheck]:
    for name, thrust in thrusts.items():
        if name[-2:] in told:
            continue
        command = f"u{name[-2:]}"
        if thrust.factor < 0 and (
            thrust.share > _EXPLAINS or _turned_round(dataset, motions, name, thrust)
        ):
            yield AdmissionCheck(
                "sign", name, f"{name} moves the other way than {command} drives it in the model",
                f"turn round the sign of {name} (pitch is positive upwards) or of {command} in "
                "the file", True,
            )  # fmt: skip
        elif thrust.share < _EXPLAINS:
            continue
        elif _near(thrust.factor, _DEGREES, _DEGREES_SPREAD):
            yield AdmissionCheck(
                "unit", name, f"{name} moves {thrust.factor:.3g} times as far as it should: "
                "degrees read as rad", f"write the unit into the header: {name}[deg]", True,
            )  # fmt: skip


def _zero(
    dataset: Dataset, motions: RecordedMotions, motion: RecordedMotion
) -> Iterator[AdmissionCheck]:
    """Whether pitch is counted from another zero than the level beam.

    Over a recording pitch goes nowhere, so its mean acceleration is that of weight and thrust
    in balance; the angle that must be added for it is where zero is.
    """
    name = "alpha_v"
    if name not in motion.accelerations:
        return
    off = _imbalance(dataset, motion, name)
    if off is None:
        return
    pitch = dataset.output(name)
    pitch = pitch[np.isfinite(pitch)]
    pitch = pitch[:: max(1, len(pitch) // _SPARSE)]
    count = round(_FARTHEST_ZERO / _ZERO_STEP)
    shifts = _ZERO_STEP * np.arange(-count, count + 1)
    weight = motions.at_rest(name, np.add.outer(shifts, pitch).ravel())
    mean = weight.reshape(len(shifts), len(pitch)).mean(axis=1)
    # Only where weight draws back: the other root is the beam upside down.
    balance = np.mean(off) + mean[count] - mean
    roots = np.flatnonzero((balance[:-1] < 0) & (balance[1:] >= 0))
    if not len(roots):
        return
    k = int(roots[np.argmin(np.abs(shifts[roots]))])
    shift = float(shifts[k] - balance[k] * _ZERO_STEP / (balance[k + 1] - balance[k]))
    if abs(shift) < _OFF_PITCH:
        return
    measurements = dataset.measurements.copy()
    measurements[:, names(dataset.outputs).index(name)] += shift
    moved = replace(dataset, measurements=measurements)
    again = _imbalance(moved, motions.of(moved), name)
    if again is None or again @ again > (1 - _ZERO_EXPLAINS) * (off @ off):
        return
    rest = float(motions.model.rest()[motions.model.state_index(name)])
    hanging = ""
    if abs(shift - rest) < _OFF_PITCH:
        hanging = ", as an encoder that was switched on while the beam hung"
    yield AdmissionCheck(
        "zero", name,
        f"{name} is off by a constant {-shift:.2f} rad: the model counts pitch from the level "
        f"beam and hangs at {rest:.2f} rad without thrust{hanging}",
        f"if so: 'data.offset={{{name}: {rest if hanging else shift:.2f}}}' adds it; if the beam "
        "is balanced otherwise or the thrusts are, leave it",
        False,
    )  # fmt: skip


def _imbalance(dataset: Dataset, motion: RecordedMotion, name: str) -> FloatArray | None:
    """Measured acceleration less the model's, rad/s², where it can be told."""
    measured, modelled = motion.accelerations[name], motion.passive[name] + motion.thrust[name]
    rows = np.isfinite(measured)
    if np.count_nonzero(rows) < _LEAST_SAMPLES or not np.isfinite(modelled).all():
        return None
    return np.asarray(measured - smoothed(modelled, dataset.sample_time))[rows]


def _turned_round(dataset: Dataset, motions: RecordedMotions, name: str, thrust: _Thrust) -> bool:
    """Whether an angle is explained well with its sign turned round, and poorly as it is."""
    measurements = dataset.measurements.copy()
    measurements[:, names(dataset.outputs).index(name)] *= -1
    other = replace(dataset, measurements=measurements)
    again = _thrusts(other, motions.of(other)).get(name)
    if again is None or again.factor < 0 or again.share < _EXPLAINS:
        return False
    return again.explained - thrust.explained > _BETTER


def _swapped(
    dataset: Dataset, motions: RecordedMotions, motion: RecordedMotion, thrusts: dict[str, _Thrust]
) -> Iterator[AdmissionCheck]:
    """Whether two inputs, or the two angles, are in each other's place."""
    inputs = names(dataset.inputs)
    poor = [t for t in thrusts.values() if t.share < _LITTLE or t.factor < 0]
    followed = _followed(dataset, motion)
    lost = [c for c, _ in followed.values() if c < _CLEAR]
    if "u_v" in inputs and "u_h" in inputs and (lost or (not followed and poor)):
        i, j = inputs.index("u_v"), inputs.index("u_h")
        order = list(range(len(inputs)))
        order[i], order[j] = j, i
        other = replace(dataset, commands=np.ascontiguousarray(dataset.commands[:, order]))
        moved = motions.of(other)
        again = _followed(other, moved)
        if followed:
            gain = min(c for c, _ in again.values()) - min(c for c, _ in followed.values())
            better = len(again) == len(followed) and min(c for c, _ in again.values()) > _CLEAR
        else:
            gain = _told(_thrusts(other, moved)) - _told(thrusts)
            better = all(t.factor > 0 and t.share > _EXPLAINS
                         for t in _thrusts(other, moved).values())  # fmt: skip
        if better and gain > _BETTER:
            yield AdmissionCheck(
                "swapped", "u_v", "u_v and u_h are in each other's place: the motion follows them "
                "the other way round",
                "swap the two columns' names (u_v is the main rotor); if the speeds are "
                "recorded, theirs may be swapped instead", True,
            )  # fmt: skip
            return
    if len(poor) == 2 and "alpha_v" in thrusts and "alpha_h" in thrusts:
        order = list(range(len(dataset.outputs)))
        i, j = (names(dataset.outputs).index(name) for name in ("alpha_v", "alpha_h"))
        order[i], order[j] = j, i
        other = replace(dataset, measurements=np.ascontiguousarray(dataset.measurements[:, order]))
        again_thrusts = _thrusts(other, motions.of(other))
        right = all(t.factor > 0 and t.share > _EXPLAINS for t in again_thrusts.values())
        if right and _told(again_thrusts) - _told(thrusts) > _BETTER:
            yield AdmissionCheck(
                "swapped", "alpha_v", "alpha_v and alpha_h are in each other's place: each moves "
                "as the other should",
                "swap the two columns' names (alpha_v is pitch)", True,
            )  # fmt: skip


def _followed(dataset: Dataset, motion: RecordedMotion) -> dict[str, tuple[float, float]]:
    """Correlation and ratio of each measured speed to the model's, where the rotor turns."""
    found = {}
    for name, modelled in motion.speeds.items():
        if name not in names(dataset.outputs):
            continue
        measured = dataset.output(name)
        rows = np.isfinite(measured)
        y, x = measured[rows], modelled[rows]
        if len(y) < _LEAST_SAMPLES or not np.isfinite(x).all():
            continue
        if np.std(x) < _TURNS or np.std(y) == 0:
            continue
        found[name] = (float(np.corrcoef(y, x)[0, 1]), float(y @ x / (x @ x)))
    return found


def _thrusts(dataset: Dataset, motion: RecordedMotion) -> dict[str, _Thrust]:
    found = {}
    for name, acceleration in motion.accelerations.items():
        rows = np.isfinite(acceleration)
        step = dataset.sample_time
        if np.count_nonzero(rows) < _LEAST_SAMPLES:
            continue
        modelled = (motion.passive[name], motion.thrust[name])
        if not np.isfinite(modelled).all():  # the model's rotors ran away
            continue
        passive, thrust = (smoothed(values, step)[rows] for values in modelled)
        if np.std(thrust) == 0:
            continue
        y = acceleration[rows]
        others = np.column_stack([passive, np.ones(len(y))])
        left = _left(y, others)
        rest, error = left, _left(y, np.column_stack([others, thrust]))
        beside = _left(thrust, others)
        factor = float(beside @ left / max(float(beside @ beside), 1e-300))
        spread = max(float(np.sum((y - y.mean()) ** 2)), 1e-300)
        found[name] = _Thrust(
            factor,
            1 - float(error @ error) / max(float(rest @ rest), 1e-300),
            1 - float(error @ error) / spread,
        )
    return found


def _told(thrusts: dict[str, _Thrust]) -> float:
    """Mean share that is explained with the right sign; 0 for none."""
    if not thrusts:
        return 0.0
    return float(np.mean([t.explained if t.factor > 0 else 0.0 for t in thrusts.values()]))


def _left(y: FloatArray, regressors: FloatArray) -> FloatArray:
    scale = np.maximum(np.abs(regressors).max(axis=0), 1e-300)
    return y - regressors / scale @ np.linalg.lstsq(regressors / scale, y, rcond=1e-9)[0]


def _near(ratio: float, value: float, spread: float) -> bool:
    return value / spread < ratio < value * spread


#: s; up to here a sample time is slow, no more.
_SLOW = 1.0
#: Samples that a period of the fastest mode needs.
SAMPLES_A_PERIOD = 6.0


def too_slow(dataset: Dataset, model: Model) -> AdmissionCheck | None:
    """What to say of a sample longer than 1 s and than a period of the model's fastest mode.

    None for any other, and for a model that steps by a time of its own.
    """
    step = dataset.sample_time
    if step <= _SLOW or model.sample_time is not None:
        return None
    scale = time_scales(dataset, model)
    if scale is None or step <= scale.fastest:
        return None
    return AdmissionCheck(
        "sample time", "",
        f"{step:.4g} s a sample, and the fastest mode of model {model.name!r} has a period of "
        f"{scale.fastest:.2g} s",
        "is t in ms? Then write t[ms] into the header; if it is not, record at least every "
        f"{scale.fastest / SAMPLES_A_PERIOD:.2g} s", True,
    )  # fmt: skip


def require_sample_time(dataset: Dataset, model: Model) -> None:
    """Refuse a recording between whose samples nothing can be simulated.

    Raises RecordingError: See :func:`too_slow`.
    """
    finding = too_slow(dataset, model)
    if finding is not None:
        raise RecordingError(finding.problem, where=dataset.source, remedy=finding.remedy)
