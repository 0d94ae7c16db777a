"""The largest amplitudes with which a simulated rig stays within its bounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.identification.dataset import FloatArray
from trms_cli.identification.excitation.request import Request
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model, names

#: s, longest integration step.
_INTEGRATION_STEP = 0.005
#: rad, how far an axis without a stop may go in the lead-in.
_FAR = 4 * np.pi
#: Samples between two looks at the bounds.
_CHECKED_AT_ONCE = 250
#: Simulations of a search for an amplitude.
_TRIALS = 9
#: Amplitudes below this share of the input's limit are none.
LEAST_SHARE = 0.01


class Trial:
    """Plays commands to a simulated rig and tells whether it stays within its bounds.

    Parameters
    ----------
    model : Model
    sample_time : float
        s.
    bounds : dict of str to float
        Largest sizes of angles from the sample ``first`` on, rad.
    first : int
        Before it only the stops count: the rig may come from beyond the bounds.
    """

    def __init__(
        self, model: Model, sample_time: float, bounds: Mapping[str, float], first: int
    ) -> None:
        self.model, self.bounds, self.first = model, dict(bounds), first
        substeps = max(1, math.ceil(sample_time / _INTEGRATION_STEP - 1e-9))
        self._discrete = discretise(model, sample_time, substeps)
        self._step = BufferedFunction(self._discrete.step)
        stops = [float(model.stops.get(name, np.inf)) for name in bounds]
        self._rows = [model.state_index(name) for name in bounds]
        self._before = np.array([s if np.isfinite(s) else _FAR for s in stops])
        self._after = np.array(list(bounds.values()))

    def play(
        self, commands: FloatArray, prior_seed: int | None = None
    ) -> tuple[FloatArray, FloatArray] | None:
        """States (n, n_x) and outputs (n, n_y); None where a bound is passed.

        Parameters
        ----------
        commands : (n, n_u) array
        prior_seed : int or None
            Of the rig's parameters, drawn from their priors; None takes the model's.
        """
        parameters = self.model.parameters
        if prior_seed is not None:
            parameters = parameters.drawn(prior_seed, 1.0)
        step, n_x = self._step, self.model.n_x
        state, u = step.inputs[0], step.inputs[1]
        state[:] = self._discrete.initial(self.model.rest(), np.zeros(self.model.n_u))
        step.inputs[2][:] = parameters.values
        step.inputs[3][:] = 0.0
        states = np.empty((len(commands), n_x))
        for begin in range(0, len(commands), _CHECKED_AT_ONCE):
            end = min(begin + _CHECKED_AT_ONCE, len(commands))
            for k in range(begin, end):
                states[k] = state[:n_x]
                u[:] = commands[k]
                step()
                state[:] = step.outputs[0]
            angles = np.abs(states[begin:end, self._rows])
            late = np.arange(begin, end)[:, None] >= self.first
            if not np.all(np.isfinite(states[begin:end])):
                return None  # without angles no bound tells
            if not np.all(angles <= np.where(late, self._after, self._before)):
                return None  # beyond, or no longer a number
        sense = self._discrete.measurement.map(len(commands))
        full = np.tile(self._discrete.initial(self.model.rest(), commands[0]), (len(commands), 1))
        full[:, :n_x] = states
        outputs = np.asarray(sense(full.T, commands.T, parameters.values)).T
        return states, outputs

    def fits(self, commands: FloatArray) -> bool:
        """Whether the simulated rig stays within its bounds."""
        return self.play(commands) is not None


def largest_amplitudes(
    model: Model,
    request: Request,
    trial: Trial,
    commands: Callable[[FloatArray], FloatArray],
    room: FloatArray,
    progress: Callable[[str], None],
) -> FloatArray:
    """Amplitudes that are given stand; the others are as large as the bounds allow.

    Parameters
    ----------
    model : Model
    request : Request
    trial : Trial
    commands : callable
        Of an amplitude (n_u,): what is played, (n, n_u).
    room : (n_u,) array
        Largest amplitudes that the inputs' limits allow.
    progress : callable
        Told in words what is being done.

    Raises
    ------
    ConfigurationError
        If nothing fits; it tells which bound is in the way, and what to change.
    """
    inputs, upper = names(model.inputs), model.input_bounds()[1]
    for name, value in request.amplitude.items():
        if name not in inputs:
            raise ConfigurationError(
                f"the model has no input {name!r}",
                where=f"amplitude.{name}",
                remedy=nearest(name, inputs),
            )
        i = inputs.index(name)
        if not 0 <= value <= room[i] / request.share + 1e-9:
            raise ConfigurationError(
                f"{value!r} given",
                where=f"amplitude.{name}",
                remedy=f"from 0 to {room[i] / request.share:.3g} {model.inputs[i].unit}",
            )
    given = np.array([request.amplitude.get(name, np.nan) for name in inputs])
    free = np.isnan(given)
    fixed = np.where(free, 0.0, given)
    if not trial.fits(commands(fixed)):
        raise ConfigurationError(
            "with the amplitudes given the simulated rig passes "
            + " or ".join(f"±{limit:.3g} rad of {name}" for name, limit in trial.bounds.items()),
            where="amplitude",
            remedy="smaller ones, or leave amplitude out to have them searched",
        )
    alone = fixed.copy()
    for i in np.flatnonzero(free).tolist():
        progress(f"amplitude of {inputs[i]}")
        one = np.zeros(len(inputs))
        one[i] = room[i]
        alone[i] = room[i] * _largest(_along(trial, commands, fixed, one))
    progress("amplitudes together")
    wanted = np.where(free, alone, 0.0)
    amplitude = fixed + wanted * _largest(_along(trial, commands, fixed, wanted))
    weak = [i for i in np.flatnonzero(free).tolist() if amplitude[i] < LEAST_SHARE * upper[i]]
    if weak:
        name = inputs[weak[0]]
        raise ConfigurationError(
            f"no amplitude of {name} keeps the simulated rig within "
            + ", ".join(f"±{limit:.3g} rad of {a}" for a, limit in trial.bounds.items()),
            where="bounds",
            remedy="wider bounds, another operating_point, a higher band.lowest or a shorter "
            "duration; or record under control, with an excitation on the references",
        )
    return amplitude


def _along(
    trial: Trial,
    commands: Callable[[FloatArray], FloatArray],
    start: FloatArray,
    direction: FloatArray,
) -> Callable[[float], bool]:
    """Whether a share of the way in a direction fits."""
    return lambda share: trial.fits(commands(start + share * direction))


def _largest(fits: Callable[[float], bool]) -> float:
    """The largest share up to 1 that fits, by bisection from above; 0 fits."""
    if fits(1.0):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(_TRIALS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low
