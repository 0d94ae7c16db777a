"""A model's equations as numbers: rates, slopes, and motions of many starts at once."""

import copy
import math
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model

#: s. Longest integration step: a tenth of the fastest time constant that is of interest.
LONGEST_STEP = 0.005


class VectorField:
    """``ẋ = f(x, u)`` of a model with its present parameters and no disturbance.

    ``model``: with equations; what impulses, delays and sensors add to it is no part of f, but of
    :meth:`motions`.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self.parameters = model.parameters.values

    @cached_property
    def function(self) -> ca.Function:
        """``(x, u, p, w) → ẋ``."""
        at = self.model.symbols()
        return ca.Function("field", list(at), [self.model.dynamics(*at)])

    @cached_property
    def slopes(self) -> ca.Function:
        """``(x, u, p, w) → ∂f/∂x, ∂f/∂u, ∂f/∂p, ∂f/∂w``, dense."""
        x, u, p, w = self.model.symbols()
        f = self.model.dynamics(x, u, p, w)
        slopes = [ca.densify(ca.jacobian(f, v)) for v in (x, u, p, w)]
        return ca.Function("slopes", [x, u, p, w], slopes)

    @cached_property
    def _w(self) -> FloatArray:
        return np.zeros(self.model.n_w)

    def rates(self, x: npt.ArrayLike, u: npt.ArrayLike) -> FloatArray:
        """f at one state (n_x,) or at many (n, n_x); u is (n_u,) or (n, n_u)."""
        x, u = np.asarray(x, dtype=float), np.asarray(u, dtype=float)
        columns = np.atleast_2d(x).T
        inputs = np.broadcast_to(np.atleast_2d(u).T, (self.model.n_u, columns.shape[1]))
        rates = np.array(self.function(columns, inputs, self.parameters, self._w)).T
        return rates[0] if x.ndim == 1 else rates

    def linearised(
        self, x: npt.ArrayLike, u: npt.ArrayLike, parameters: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """``A = ∂f/∂x`` (n_x, n_x) and ``B = ∂f/∂u`` (n_x, n_u)."""
        _, a, b = self.with_slopes(x, u, parameters)
        return a, b

    def with_slopes(
        self, x: npt.ArrayLike, u: npt.ArrayLike, parameters: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """f (n_x,), A and B at one state, in one evaluation."""
        p = self.parameters if parameters is None else parameters
        f, a, b = self._at_once.evaluate(x, u, p, self._w)
        return f.copy(), a.copy().reshape(f.size, -1), b.copy().reshape(f.size, -1)

    @cached_property
    def _at_once(self) -> BufferedFunction:
        """f, A and B: some hundreds of evaluations at the most are not worth a compiler."""
        x, u, p, w = self.model.symbols()
        f = self.model.dynamics(x, u, p, w)
        slopes = [ca.jacobian(f, v) for v in (x, u)]
        function = ca.Function("at_once", [x, u, p, w], ca.cse([f, *slopes]))
        return BufferedFunction(function, compile=False)

    def motions(
        self,
        starts: npt.ArrayLike,
        u: npt.ArrayLike,
        duration: float,
        step: float,
        *,
        impulses: bool = True,
    ) -> FloatArray:
        """Motions from many starts with the command held.

        ``starts``: (m, n_x). ``u``: (n_u,) or (m, n_u). ``duration``: s. ``step``: s between two
        states; integrated in equal parts of at most :data:`LONGEST_STEP`. ``impulses``: whether dry
        friction and stops act. Returns (n + 1, m, n_x): NaN from where a motion is no longer
        finite.
        """
        starts = np.atleast_2d(np.asarray(starts, dtype=float))
        m, steps = len(starts), max(1, round(duration / step))
        model = self.model if impulses else without_impulses(self.model)
        discrete = discretise(model, step, max(1, math.ceil(step / LONGEST_STEP - 1e-9)))
        every = BufferedFunction(discrete.step.map(m))
        x, commands, p, _ = every.inputs
        columns = x.reshape(discrete.n_x, m, order="F") if m == 1 else x
        inputs = np.broadcast_to(np.asarray(u, dtype=float), (m, model.n_u))
        for i in range(m):
            columns[:, i] = discrete.initial(starts[i], inputs[i])
        commands.reshape(model.n_u, m, order="F")[:] = inputs.T
        if p.size:
            p.reshape(self.parameters.size, m, order="F")[:] = self.parameters[:, None]
        states = np.empty((steps + 1, m, model.n_x))
        states[0] = columns[: model.n_x].T
        for k in range(steps):
            every()
            x[...] = every.outputs[0]
            states[k + 1] = columns[: model.n_x].T
        return states


def has_impulses(model: Model) -> bool:
    """Whether dry friction or stops act on the states: then a motion has no slopes."""
    x, u, p, w = model.symbols()
    return not ca.is_equal(ca.densify(model.impulse(x, u, p, w, 0.01)), x, 0)


def holds_at_rest(model: Model) -> bool:
    """Whether dry friction may stop an axis or rotor, set-valued as it is: then no push shows."""
    return model.sample_time is None and model.friction_holds and has_impulses(model)


def without_impulses(model: Model) -> Model:
    """The model with its axes gliding freely: no dry friction, no stops.

    Set-valued friction holds an axis that rests: the rig would have no slopes there.
    """
    gliding = copy.copy(model)
    gliding.impulse = _no_impulse  # type: ignore[method-assign]
    return gliding


def _no_impulse(x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX, duration: float) -> ca.SX:
    """In place of a model's own; see :meth:`trms_cli.models.model.Model.impulse`."""
    return x
