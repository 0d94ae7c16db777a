"""The largest amplitudes with which a simulated rig stays within its bounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from trms_cli.core.errors import ConfigurationError, SimulationError
from trms_cli.core.plugins import nearest
from trms_cli.identification.dataset import FloatArray
from trms_cli.identification.excitation.request import Request
from trms_cli.models.model import Model, names
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.simulated import SimulatedRig

#: Simulations of a search for an amplitude.
_TRIALS = 9
#: Amplitudes below this share of the input's limit are none.
LEAST_SHARE = 0.01


class Trial:
    """Plays commands to the simulated rig and tells whether it stays within the bounds."""

    def __init__(self, model: Model, request: Request, bounds: Mapping[str, float]) -> None:
        self.model, self.request, self.bounds = model, request, bounds
        self.count = 0

    def play(
        self, commands: FloatArray, prior_seed: int | None = None
    ) -> tuple[FloatArray, FloatArray] | None:
        """States and outputs (n, …); None where a bound is passed."""
        self.count += 1
        rig = SimulatedRig(model=self.model, mechanical_stops=False, prior_seed=prior_seed)
        run = rig.init(PlantSetup(self.request.sample_time, len(commands), 0))
        watched = [(self.model.state_index(name), limit) for name, limit in self.bounds.items()]
        states = np.empty((len(commands), self.model.n_x))
        outputs = np.empty((len(commands), self.model.n_y))
        try:
            for k, u in enumerate(commands):
                outputs[k] = run.measure()
                states[k] = run.state
                if any(abs(states[k, i]) > limit for i, limit in watched):
                    return None
                run.advance(u)
        except SimulationError:
            return None
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
            remedy="smaller ones, or amplitude={} to have them searched",
        )
    alone = fixed.copy()
    for i in np.flatnonzero(free):
        progress(f"amplitude of {inputs[i]}")
        one = np.zeros(len(inputs))
        one[i] = room[i]
        alone[i] = room[i] * _largest(_along(trial, commands, fixed, one))
    progress("amplitudes together")
    wanted = np.where(free, alone, 0.0)
    amplitude = fixed + wanted * _largest(_along(trial, commands, fixed, wanted))
    weak = [i for i in np.flatnonzero(free) if amplitude[i] < LEAST_SHARE * upper[i]]
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
