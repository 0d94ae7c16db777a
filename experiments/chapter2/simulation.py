"""Models in open loop, compiled once each, and the figures by which two responses are compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.effects.extended_model import extend_model
from trms_cli.models.model import Model, names
from trms_cli.plants.simulated import with_stops
from trms_cli.simulation.rollout import Rollout

FloatArray = npt.NDArray[np.float64]
#: Share of a stop's angle from which on the frame counts as touched.
_TOUCHED = 0.999


@dataclass(frozen=True)
class Response:
    """A model's answer to commands."""

    time: FloatArray  #: (n,) array; s
    commands: FloatArray  #: (n, n_u) array; V
    outputs: dict[str, FloatArray]  #: dict of str to (n,) array; by name, in SI
    stopped: bool  #: Whether a mechanical stop was reached


@dataclass(frozen=True)
class Difference:
    """Of one output of a model from that of another, which is the measure."""

    rms: float  #: In the output's unit
    largest: float  #: In the output's unit
    #: ``100 (1 − ‖difference‖/‖output − its mean‖)``, percent; NaN where the output rests
    fit: float


def difference(response: FloatArray, measure: FloatArray) -> Difference:
    """Compare two records of one output, shape (n,)."""
    error = response - measure
    spread = float(np.linalg.norm(measure - measure.mean()))
    fit = 100 * (1 - float(np.linalg.norm(error)) / spread) if spread > 1e-9 else float("nan")
    return Difference(float(np.sqrt(np.mean(error**2))), float(np.abs(error).max()), fit)


class OpenLoop:
    """Simulates a model, with the frame's stops unless told otherwise.

    Parameters
    ----------
    model : Model
    sample_time : float
        s.
    substeps : int
    stops : bool
        Whether the frame ends the travel of each axis.
    """

    def __init__(
        self, model: Model, sample_time: float, substeps: int, *, stops: bool = True
    ) -> None:
        self.model = extend_model(model, with_stops(model)) if stops else model
        self._sample_time = sample_time
        self._rollout = Rollout(self.model, sample_time, substeps=substeps)

    def respond(
        self,
        commands: FloatArray,
        start: Mapping[str, float] | None = None,
        parameters: FloatArray | None = None,
    ) -> Response:
        """From rest, or from states that differ from it by name.

        ``commands``: (n, n_u) array; V, constant from each sample to the next. ``parameters``:
        (n_p,) array; other values for all parameters.
        """
        x = self.model.rest()
        for name, value in (start or {}).items():
            x[self.model.state_index(name)] = value
        begin = self._rollout.initial(x, np.zeros(self.model.n_u))[None, :]
        y = self._rollout.outputs(commands, [0], [len(commands)], begin, parameters).y
        outputs = dict(zip(names(self.model.outputs), y.T, strict=True))
        stopped = any(
            np.abs(outputs[name]).max() >= _TOUCHED * stop
            for name, stop in self.model.stops.items()
        )
        time = np.arange(len(commands), dtype=np.float64) * self._sample_time
        return Response(time, commands, outputs, bool(stopped))
