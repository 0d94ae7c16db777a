"""Periodic orbits by multiple shooting, with the variational equations beside the motion.

A periodic orbit of ``ẋ = f(x, u)`` with the command held obeys

    φ(X_i; T/m, u) = X_{i+1},  i = 0 … m−1,  X_m = X_0        m pieces of equal time
    f(x̂_0, u)·(X_0 − x̂_0) = 0                                 where on the orbit it begins

φ is the discretised model's step, many times over. The product of the steps' Jacobians is the
Jacobian of φ to rounding (no differencing), and over a whole period the monodromy matrix, whose
eigenvalues are the Floquet multipliers. One of them is 1, along the orbit: how far the computed one
is from 1 tells how good the orbit is.

After Kuznetsov, "Elements of Applied Bifurcation Theory" (3rd ed. 2004), ch. 1.5 and 10.2, and
Ascher, Mattheij & Russell (1995) on multiple shooting. The equations of Newton's method are solved
as one dense system: they are few.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import FloatArray, Model
from trms_cli.models.parameters import Parameter
from trms_cli.models.vector_field import VectorField

_ITERATIONS = 25
#: Largest misfit of a closed orbit, in the states' units.
_CLOSED = 1e-9
#: A Newton step that does not lessen the misfit is halved this often before it is given up.
_HALVINGS = 8
#: Newton's method is given up when the period leaves this share of its guess (or its inverse), or
#: the orbit shrinks by this: it is on its way to an equilibrium.
_SHORTEST, _COLLAPSED = 0.4, 0.05
#: A multiplier this far within the unit circle counts as stable.
MARGIN = 1e-6


@dataclass(frozen=True)
class Orbit:
    """A closed orbit."""

    nodes: FloatArray  #: (m, n_x) array; states at the beginnings of its pieces
    period: float  #: s
    u: FloatArray  #: (n_u,) array; the command held
    #: (n_x,) complex array; floquet multipliers, the trivial one first, then by falling size
    multipliers: npt.NDArray[np.complex128]
    #: (n + 1, n_x) array; the orbit at equal steps of time, its first state again at the end
    path: FloatArray
    misfit: float  #: Largest residual of the equations

    @property
    def swing(self) -> FloatArray:
        """Peak to peak of each state, (n_x,)."""
        return np.ptp(self.path, axis=0)

    @property
    def trivial_error(self) -> float:
        """How far the multiplier along the orbit is from 1."""
        return float(abs(self.multipliers[0] - 1.0))

    @property
    def largest(self) -> complex:
        """The largest multiplier but the trivial one; 0 for a model of one state."""
        return complex(self.multipliers[1]) if len(self.multipliers) > 1 else 0j

    @property
    def stable(self) -> bool:
        """Whether all multipliers but the trivial one lie within the unit circle."""
        return abs(self.largest) < 1.0 - MARGIN

    @property
    def time(self) -> FloatArray:
        """s, of the rows of ``path``."""
        return np.linspace(0.0, self.period, len(self.path))


@dataclass(frozen=True)
class Pieces:
    """What shooting from the nodes gives."""

    ends: FloatArray  #: (m, n_x) array
    by_state: FloatArray  #: (m, n_x, n_x) array; ∂end/∂node
    by_period: FloatArray  #: (m, n_x) array
    by_input: FloatArray  #: (m, n_x, n_u) array
    path: FloatArray  #: (m, k + 1, n_x) array; the pieces' steps


class Shooting:
    """Shoots a model's orbits.

    Parameters
    ----------
    model : Model
        With equations.
    pieces : int
        m. More make Newton's method surer for orbits that leave their neighbours fast.
    steps : int
        Integration steps a period, rounded up to a multiple of the pieces.
    """

    def __init__(self, model: Model, pieces: int = 10, steps: int = 800) -> None:
        self.model = model
        self.field = VectorField(model)
        self.pieces = pieces
        self.per_piece = math.ceil(steps / pieces)

    @cached_property
    def _step(self) -> BufferedFunction:
        step = 1.0 / (self.pieces * self.per_piece)
        linearised = discretise(InPeriods(self.model), step).linearised()
        return BufferedFunction(linearised.map(self.pieces))

    def shoot(self, nodes: FloatArray, period: float, u: FloatArray) -> Pieces:
        """Motions from all nodes at once, with their slopes."""
        m, n, n_u = self.pieces, self.model.n_x, self.model.n_u
        step = self._step
        x, command, p, w = step.inputs
        x[...] = nodes.T
        command[...] = u[:, None]
        p[...] = np.append(self.field.parameters, period)[:, None]
        w[...] = 0.0
        by_state = np.broadcast_to(np.eye(n), (m, n, n)).copy()
        by_period, by_input = np.zeros((m, n)), np.zeros((m, n, n_u))
        path = np.empty((m, self.per_piece + 1, n))
        path[:, 0] = nodes
        after, slope, input_slope, parameter_slope, _ = step.outputs
        last = len(self.field.parameters)
        for k in range(self.per_piece):
            step()
            a = slope.reshape(n, n, m, order="F").transpose(2, 0, 1)
            b = input_slope.reshape(n, n_u, m, order="F").transpose(2, 0, 1)
            g = parameter_slope.reshape(n, last + 1, m, order="F")[:, last].T
            by_state = a @ by_state
            by_period = (a @ by_period[:, :, None])[:, :, 0] + g
            by_input = a @ by_input + b
            x[...] = after
            path[:, k + 1] = after.T
        return Pieces(path[:, -1].copy(), by_state, by_period, by_input, path)

    def closed(
        self, nodes: FloatArray, period: float, u: FloatArray, *, row: BranchCondition | None = None
    ) -> Orbit | None:
        """The orbit near a guess, by damped Newton steps; None where there is none.

        Parameters
        ----------
        nodes : (m, n_x)
        period : float
            s.
        u : (n_u,)
        row : BranchCondition, optional
            Frees one command, and fixes the place on a branch of orbits instead.
        """
        anchor, direction = nodes[0].copy(), self.field.rates(nodes[0], u)
        size = float(np.linalg.norm(direction))
        if size < 1e-12:
            return None
        direction = direction / size
        widest = float(np.ptp(nodes, axis=0).max())
        z = packed(nodes, period, u, row)
        linearised = self._equations(z, u, anchor, direction, row)
        for _ in range(_ITERATIONS):
            if linearised is None:
                return None
            residual, slope, _ = linearised
            misfit = float(np.abs(residual).max())
            if misfit < _CLOSED:
                return self._orbit(z, u, row, misfit, linearised[2])
            change = np.linalg.lstsq(slope, residual, rcond=1e-13)[0]
            for halving in range(_HALVINGS):
                trial = z - change / 2.0**halving
                tried = self._equations(trial, u, anchor, direction, row)
                if tried is not None and np.abs(tried[0]).max() < misfit:
                    break
            else:
                # At the limit of rounding a step may not lessen what is small already.
                small = misfit < 1e3 * _CLOSED
                return self._orbit(z, u, row, misfit, linearised[2]) if small else None
            z, linearised = trial, tried
            now = z[: nodes.size].reshape(nodes.shape)
            if not _SHORTEST < z[nodes.size] / period < 1.0 / _SHORTEST or (
                row is None and np.ptp(now, axis=0).max() < _COLLAPSED * widest
            ):
                return None
        return None

    def _equations(
        self,
        z: FloatArray,
        u: FloatArray,
        anchor: FloatArray,
        direction: FloatArray,
        row: BranchCondition | None,
    ) -> tuple[FloatArray, FloatArray, Pieces] | None:
        """Residuals, their slopes and the pieces; None where a motion leaves all bounds."""
        m, n = self.pieces, self.model.n_x
        nodes, period, command = unpacked(z, m, n, u, row)
        if not (period > 0 and np.all(np.isfinite(z))):
            return None
        pieces = self.shoot(nodes, period, command)
        if not (np.all(np.isfinite(pieces.ends)) and np.all(np.isfinite(pieces.by_state))):
            return None
        following = np.roll(nodes, -1, axis=0)
        residual = [(pieces.ends - following).ravel(), [float(direction @ (nodes[0] - anchor))]]
        slope = np.zeros((m * n + 1, z.size))
        for i in range(m):
            rows = slice(i * n, (i + 1) * n)
            slope[rows, rows] = pieces.by_state[i]
            j = (i + 1) % m
            slope[rows, j * n : (j + 1) * n] -= np.eye(n)
            slope[rows, m * n] = pieces.by_period[i]
            if row is not None:
                slope[rows, m * n + 1] = pieces.by_input[i, :, row.channel]
        slope[m * n, :n] = direction
        if row is not None:
            residual.append([float(row.weights @ (z - row.place)) - row.length])
            slope = np.vstack([slope, row.weights])
        return np.concatenate([np.asarray(part, dtype=float) for part in residual]), slope, pieces

    def _orbit(
        self,
        z: FloatArray,
        u: FloatArray,
        row: BranchCondition | None,
        misfit: float,
        pieces: Pieces,
    ) -> Orbit:
        m, n = self.pieces, self.model.n_x
        nodes, period, command = unpacked(z, m, n, u, row)
        monodromy = np.eye(n)
        for i in range(m):
            monodromy = pieces.by_state[i] @ monodromy
        path = np.vstack([pieces.path[:, :-1].reshape(-1, n), pieces.path[-1, -1:]])
        return Orbit(
            nodes,
            period,
            command,
            _sorted(np.linalg.eigvals(monodromy).astype(complex)),
            path,
            misfit,
        )


@dataclass(frozen=True)
class BranchCondition:
    """One more equation, which fixes the place on a branch while a command is free.

    ``weights · (z − place) = length``, z = [nodes, T, the free command].
    """

    channel: int  #: Of the command that is free
    weights: FloatArray  #: (m n_x + 2,) arrays
    place: FloatArray  #: (m n_x + 2,) arrays
    length: float


def packed(
    nodes: FloatArray, period: float, u: FloatArray, row: BranchCondition | None
) -> FloatArray:
    """The unknowns as one vector."""
    tail = [period] if row is None else [period, u[row.channel]]
    return np.concatenate([nodes.ravel(), tail])


def unpacked(
    z: FloatArray, m: int, n: int, u: FloatArray, row: BranchCondition | None
) -> tuple[FloatArray, float, FloatArray]:
    """Nodes, period and command of a vector of unknowns."""
    command = u.copy()
    if row is not None:
        command[row.channel] = z[m * n + 1]
    return z[: m * n].reshape(m, n), float(z[m * n]), command


def _sorted(multipliers: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
    """The one nearest to 1 first, the others by falling size."""
    trivial = int(np.argmin(np.abs(multipliers - 1.0)))
    others = np.delete(multipliers, trivial)
    order = np.argsort(-np.abs(others), kind="stable")
    return np.concatenate([multipliers[trivial : trivial + 1], others[order]]).astype(complex)


#: Name of the period among the parameters.
PERIOD = "the_period"


class InPeriods(Model):
    """A model whose time is counted in periods; the period is its last parameter, s.

    Parameters
    ----------
    base : Model
        With equations. What impulses, delays and sensors add to it is left out: f must be
        differentiable for the variational equations.
    """

    def __init__(self, base: Model) -> None:
        self.base = base
        self.name = base.name
        self.states, self.inputs, self.outputs = base.states, base.inputs, base.outputs
        self.disturbances = base.disturbances
        self.parameters = base.parameters.joined([Parameter(PERIOD, 1.0, "s", lower=0.0)])
        self.controlled, self.input_limits = base.controlled, base.input_limits
        self.stops, self.axes, self.rotors = base.stops, base.axes, base.rotors
        self.stiff = base.stiff

    def rest(self) -> FloatArray:
        return self.base.rest()

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        n = len(self.base.parameters)
        return p[n] * self.base.dynamics(x, u, p[:n, 0], w)

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return self.base.measurement(x, u, p[: len(self.base.parameters), 0])
