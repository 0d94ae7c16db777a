"""What the model predicts of the next sample, with the errors that every model has.

An extended Kalman filter with the model's parameters as they are given, and beside the state what
`diagnose` allows a model to err by:

    x⁺ = F(x, u, p + s θ, f)        f⁺ = ρ f + ω_f        θ⁺ = θ + ω_θ        y = h(x) + ν

Coloured forces f on the equations whiten the innovations as those of
:mod:`trms_cli.gap.discrepancy` do; the deviations θ of the parameters, in standard deviations s of
their priors, are what a refit would take. So nothing is a change that another parameter, learnt
while the rig was as it was, has explained already. The sizes of f are set by whoever tests; those
of the noise ν follow from E[e e_left] = R (Desroziers et al. 2005, Q. J. R. Meteorol. Soc. 131),
with e the innovations and e_left what the update leaves of them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.process_cache import call_memoised
from trms_cli.gap.watch.filter_step import FilterArrays
from trms_cli.models.discretisation import DiscreteModel, discretise
from trms_cli.models.model import Model, names
from trms_cli.models.rest import resting_state
from trms_cli.models.state_kinds import kinds_of_disturbances, kinds_of_states
from trms_cli.observers.augmentation import InitialSd, ProcessNoise
from trms_cli.observers.observer import ObserverSetup

#: s; explicit integration steps are no longer.
_LONGEST_SUBSTEP = 0.02
#: White noise on the states, as a share of what an observer takes: the forces are there beside it.
_NOISE_SHARE = 0.1
#: Sizes of the forces as shares of an observer's first uncertainty of a torque (10 mN m on an
#: axis): at first, and at least.
_FIRST_FORCE, _LEAST_FORCE = 0.02, 0.002
#: s, in which the parameters are taken as given: a state that is not known yet would bend them.
_KNOWN = 2.0
#: 1/√s, by which a parameter spreads, in deviations of its prior.
_WALK = 0.02
#: Share of a channel's declared variance that it has at least.
_LEAST_NOISE = 0.1
#: s, over which the noise is averaged: at the beginning, and at most.
_FIRST_AVERAGE, _LONGEST_AVERAGE = 2.0, 120.0


@dataclass(frozen=True)
class _Functions:
    """The equations of one model over a sample, with their slopes."""

    discrete: DiscreteModel
    step: ca.Function  #: ``(x, u, p, w) → x⁺, ∂x⁺/∂x, ∂x⁺/∂w, ∂x⁺/∂p``
    measure: ca.Function  #: ``(x, u, p) → y, ∂y/∂x``


def _functions(
    model: Model, sample_time: float, channels: tuple[int, ...], free: tuple[int, ...]
) -> _Functions:
    substeps = 1
    if model.sample_time is None:
        substeps = max(1, int(np.ceil(sample_time / _LONGEST_SUBSTEP - 1e-9)))
    discrete = discretise(model, sample_time, substeps, sensors=True)
    x, u, p, w = discrete.symbols()
    after = discrete.step(x, u, p, w)
    slopes = [ca.densify(ca.jacobian(after, v)) for v in (x, w)]
    slopes.append(ca.densify(ca.jacobian(after, p)[:, list(free)]))
    y = discrete.measurement(x, u, p)[list(channels)]
    measured = [y, ca.densify(ca.jacobian(y, x))]
    return _Functions(
        discrete,
        ca.Function("watch_step", [x, u, p, w], ca.cse([after, *slopes])),
        ca.Function("watch_measure", [x, u, p], ca.cse(measured)),
    )


class Predictor:
    """The filter during one run.

    Raises ConfigurationError for a channel that the model knows nothing of, or whose noise nobody
    declared.
    """

    def __init__(self, setup: ObserverSetup, correlation_time: float) -> None:
        model = self.model = setup.model
        self.sample_time = setup.sample_time
        self._per_second = max(1, round(1.0 / setup.sample_time))
        channels = setup.channels()
        noise_sd = np.array([setup.noise_sd.get(name, 0.0) for name in setup.outputs])
        for name, sd in zip(setup.outputs, noise_sd, strict=True):
            if not sd > 0:
                raise ConfigurationError(
                    f"the noise of {name!r} is not declared",
                    where="gap_watch",
                    remedy=f"declare it with the rig (plant.sensors.noise.{name}), or "
                    "gap_watch=none",
                )
        parameters = list(model.parameters)
        free = tuple(i for i, each in enumerate(parameters) if each.prior_sd and each.value)
        self.free: IntArray = np.array(free, dtype=np.int64)
        spreads = [abs(parameters[i].value) * (parameters[i].prior_sd or 0.0) for i in free]
        self._spread = np.array(spreads, dtype=float)
        own = call_memoised(_functions, model, setup.sample_time, tuple(channels), free)
        self._step, self._measure = BufferedFunction(own.step), BufferedFunction(own.measure)
        n_x, n_w = own.discrete.n_x, model.n_w
        self.n_x, self.n_w = n_x, n_w
        self.arrays = FilterArrays(n_x + n_w, n_x + n_w + len(free), len(channels))
        #: (n_w,) array; N m, an observer's first uncertainty of each torque
        self.usual_force = np.array(
            [getattr(InitialSd(), kind) for kind in kinds_of_disturbances(model)], dtype=float
        )
        self._prior_sd, self._noise_of_states = self._sds(n_x)
        self._first_noise = noise_sd**2
        self._decay = float(np.exp(-setup.sample_time / correlation_time))
        first = dict(zip(setup.outputs, setup.first_measurement.tolist(), strict=True))
        self._rest = own.discrete.initial(
            resting_state(model, first, setup.first_command), setup.first_command
        )
        self._prepare(setup.first_command)
        self.restart(everything=True)

    def _sds(self, n_x: int) -> tuple[FloatArray, FloatArray]:
        """Prior standard deviation and noise intensity of each state; memory has none."""
        prior, noise = InitialSd(), ProcessNoise()
        sds, intensities = np.zeros(n_x), np.zeros(n_x)
        for i, kind in enumerate(kinds_of_states(self.model)):
            sds[i] = getattr(prior, kind)
            intensities[i] = _NOISE_SHARE * getattr(noise, kind)
        return sds, intensities

    def _prepare(self, first_command: FloatArray) -> None:
        """What stays the same in the arrays of the filter."""
        n_x, d, own = self.n_x, self.arrays.d, self.arrays
        own.f[range(n_x, d), range(n_x, d)] = self._decay
        own.q[:n_x] = self._noise_of_states**2 * self.sample_time
        own.q[d:] = _WALK**2 * self.sample_time
        own.r[:] = self._first_noise
        own.least_noise[:] = _LEAST_NOISE * self._first_noise
        self._least_force = (_LEAST_FORCE * self.usual_force) ** 2
        #: (n_w,) array; variance of each equation's coloured force
        self.force_variance = (_FIRST_FORCE * self.usual_force) ** 2
        #: (n_w,) array; N m, the forces now
        self.forces = np.zeros(self.n_w)
        #: (n_θ,) array; deviations of the parameters, in those of their priors
        self.deviations = np.zeros(len(self.free))
        self._nominal = self.model.parameters.values
        self._p = self._nominal.copy()
        self._none = np.zeros(self.n_w)
        #: (n_x, n_w) array; what a unit of each force does to the state in a sample
        self.push = np.zeros((self.n_x, self.n_w))
        #: (n_x, n_θ) array; what a deviation of each parameter does
        self.pull = np.zeros((self.n_x, len(self.free)))
        self.samples = 0
        _, _, push, _ = self._step.evaluate(self._rest, first_command, self._p, self._none)
        of_states = np.abs(push.reshape(self.n_x, self.n_w))[: self.model.n_x]
        #: State that each force moves most
        self.pushed: list[int] = of_states.argmax(axis=0).tolist()

    def restart(self, *, everything: bool = False, parameters: bool = True) -> None:
        """Be as uncertain as before the first sample, of the parameters only if asked for.

        ``everything``: begin with the first state and the parameters as given, too.
        """
        n_x, d, own = self.n_x, self.arrays.d, self.arrays
        kept = own.p[d:, d:].copy()
        own.p[...] = 0.0
        own.p[range(n_x), range(n_x)] = self._prior_sd**2
        own.p[range(n_x, d), range(n_x, d)] = self.force_variance
        own.p[d:, d:] = np.eye(own.n - d) if parameters or everything else kept
        self.forces[:] = 0.0
        if everything:
            self.x = self._rest.copy()
            self.forget_deviations()
        self.before = self.x

    def forget_deviations(self) -> None:
        """Take the parameters as they are given again."""
        self.deviations[:] = 0.0
        self._p[:] = self._nominal

    def step(self, command: FloatArray, measurement: FloatArray, gate: float) -> bool:
        """Predict a sample and take it in; False if the filter had to begin anew.

        ``arrays.state`` says which channels are to be believed, and afterwards which were.
        """
        own, n_x, d = self.arrays, self.n_x, self.arrays.d
        advance = self.samples > 0
        self.samples += 1
        if advance:
            self.before = self.x
            after, a, push, pull = self._step.evaluate(self.x, command, self._p, self.forces)
            self.push[...] = push.reshape(n_x, self.n_w)
            np.multiply(pull.reshape(n_x, -1), self._spread, out=self.pull)
            own.f[:n_x, :n_x] = a
            own.f[:n_x, n_x:d] = self.push
            if self.samples * self.sample_time > _KNOWN:
                own.f[:n_x, d:] = self.pull
            own.q[n_x:d] = self.force_variance * (1 - self._decay**2)
            self.forces *= self._decay
            self.x = after.copy()
        y, h = self._measure.evaluate(self.x, command, self._p)
        own.h[...] = 0.0
        own.h[:, :n_x] = h
        np.subtract(measurement, y, out=own.e)
        if not own.update(advance=advance, gate=gate, pace=self._pace()):
            self.restart(everything=True)
            return False
        self.x += own.dx[:n_x]
        self.forces += own.dx[n_x:d]
        self.deviations += own.dx[d:]
        self._p[self.free] = self._nominal[self.free] + self._spread * self.deviations
        if not math.isfinite(sum(self.x.tolist())):
            self.restart(everything=True)
            return False
        if self.samples % self._per_second == 0:
            self.limit_deviations()
        return True

    def _pace(self) -> float:
        """Share of the way by which the noise follows a sample; none in the first second."""
        since = self.samples * self.sample_time
        if since < 1.0:
            return 0.0
        return self.sample_time / min(_FIRST_AVERAGE + since, _LONGEST_AVERAGE)

    def loosen(self, states: Sequence[int]) -> None:
        """Know some states as little as at first: something else has hold of them."""
        for i in states:
            self.arrays.p[i, i] += self._prior_sd[i] ** 2

    def limit_deviations(self) -> None:
        """Let no parameter be less known than its prior, however long it has not shown itself."""
        own, d = self.arrays, self.arrays.d
        scale = np.ones(own.n)
        scale[d:] = 1.0 / np.sqrt(np.maximum(np.diag(own.p)[d:], 1.0))
        own.p *= scale[:, None] * scale

    def adapt_forces(self, factors: FloatArray) -> None:
        """Multiply the variances of the coloured forces, (n_w,)."""
        self.force_variance *= factors
        np.maximum(self.force_variance, self._least_force, out=self.force_variance)

    def standing_forces(self) -> FloatArray:
        """What the equations lack without the deviations and forces, (n_w,) N m."""
        shift = self.pull @ self.deviations
        norms = np.maximum((self.push**2).sum(axis=0), 1e-300)
        return np.asarray(self.push.T @ shift / norms + self.forces)


def angle_of(model: Model, equation: str) -> int | None:
    """Position of the angle that an equation's torque turns; None for one of a rotor."""
    for axis in model.axes.values():
        if axis.moment == equation:
            return names(model.states).index(axis.angle)
    return None
