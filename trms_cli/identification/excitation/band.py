"""The band of an excitation: from a model's slowest to its fastest mode where it is excited."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.model import Model

#: What is excited beyond the slowest and the fastest pole.
_BELOW, _ABOVE = 0.2, 5.0
#: rad/s: poles beyond are armature currents, poles below integrate.
_FASTEST, _SLOWEST = 100.0, 1e-3
#: Share of the Nyquist frequency that a band may reach.
_SHARE_OF_NYQUIST = 0.8


@dataclass(frozen=True)
class Linearised:
    """``ẋ = A x + B u, y = C x + D u`` at a point."""

    a: FloatArray  #: (n_x, n_x), 1/s and so on
    b: FloatArray  #: (n_x, n_u)
    c: FloatArray  #: (n_y, n_x)
    d: FloatArray  #: (n_y, n_u)

    def response(self, frequencies: FloatArray) -> FloatArray:
        """Frequency response, (m, n_y, n_u), at frequencies in Hz."""
        eye = np.eye(len(self.a))
        return np.array(
            [
                self.c @ np.linalg.solve(2j * np.pi * f * eye - self.a, self.b) + self.d
                for f in frequencies
            ]
        )


def linearised(model: Model, x: FloatArray, u: FloatArray) -> Linearised:
    """A model with a derivative, linearised at a point.

    Raises ConfigurationError for a model that only steps.
    """
    if model.sample_time is not None:
        raise ConfigurationError(
            f"model {model.name!r} has no poles: it only steps",
            where="model",
            remedy="design with a model with equations, as model=newtonian",
        )
    xs, us, p, w = model.symbols()
    f, y = model.dynamics(xs, us, p, w), model.measurement(xs, us, p)
    slopes = [ca.jacobian(of, by) for of in (f, y) for by in (xs, us)]
    evaluate = ca.Function("slopes", [xs, us, p, w], slopes)
    values = evaluate(x, u, model.parameters.values, np.zeros(model.n_w))
    return Linearised(*(np.asarray(ca.densify(value)) for value in values))


def pole_range(system: Linearised) -> tuple[float, float]:
    """Distance of the slowest and of the fastest pole of interest from zero, rad/s."""
    sizes = np.abs(np.linalg.eigvals(system.a))
    sizes = sizes[(sizes > _SLOWEST) & (sizes < _FASTEST)]
    return float(sizes.min()), float(sizes.max())


def band_of(
    system: Linearised,
    sample_time: float,
    duration: float,
    lowest: float | None = None,
    highest: float | None = None,
) -> tuple[float, float]:
    """The band in Hz: what is given stands, the rest comes from the poles.

    From a fifth of the slowest pole, but at least one period in the duration, to five times the
    fastest, but at most 0.8 of the Nyquist frequency.
    """
    slow, fast = pole_range(system)
    if lowest is None:
        lowest = max(_BELOW * slow / (2 * np.pi), 1 / duration)
    if highest is None:
        highest = min(_ABOVE * fast / (2 * np.pi), _SHARE_OF_NYQUIST * 0.5 / sample_time)
    return float(lowest), float(highest)
