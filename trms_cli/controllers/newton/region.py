"""Terminal cost and terminal region of the quasi-infinite horizon.

After Chen & Allgöwer 1998 (Automatica 34). Around a target the local law is the linear-quadratic
regulator of the linearised model with the objective's own weights, on states, rates, inputs and
moves, and some more. The moves make the last input a state, so that with
``ξ = (x − x_s, u₋ − u_s)``, memory of the input path included,

    ξ⁺ = A_K ξ,   ℓ(ξ) = ξᵀ Q_K ξ,   V(ξ) = ξᵀ P ξ,   P = A_Kᵀ P A_K / (1 − κ) + Q_K + W_K

with ℓ the objective's stage cost under the law. W weighs every state and input by its typical size
(``terminal_weight`` times what the objective takes the weighted states' sizes for), and
``κ = terminal_decay (1 − ρ(A_K)²)``. Both make V fall by more than ℓ, which is what the
nonlinearity may eat up. A law for the objective alone is harsh, its V hardly sees the rotors'
speeds, and its region is a thousandth of a radian wide. With both 0, V is the regulator's own cost
to infinity. The region is ``ξᵀ P ξ ≤ α``, with α the largest on which

- the law keeps the inputs' bounds, their rate limits and the soft limits of states (exact: the
  width of an ellipsoid), and
- the nonlinear model obeys ``V(ξ⁺) − V(ξ) ≤ −ℓ(ξ)``: searched, not proved. Over a fixed set of
  directions on several shells, and then around the worst of them, the largest gap is followed; the
  radius is cut until none is positive, and α then once more by a safety factor.

At a target without thrust slope (a tail rotor that stands still) the law cannot drive that axis.
Where the axis comes to rest by itself (a cable that pulls back) V is the cost of its free decay.
Where it does not, no quadratic V exists: under a law that is linear in ξ a thrust that goes as ω|ω|
changes the state by the order of ξ², and V by that of ξ³, while ℓ is of the order of ξ²; a slope
assumed in the law's design does not change that. There, and where a bound is active at the target,
is no region, and the terminal equality stays.
"""

import warnings
from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.controllers.horizon import Horizon
from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.model import names
from trms_cli.models.steady_state import Target

#: Directions in which the decrease is checked, and around the worst of which it is once more.
_DIRECTIONS, _WORST, _ROUNDS = 512, 16, 6
#: Shells inside the ellipsoid, as shares of its radius.
_SHELLS = (1.0, 0.8, 0.6, 0.4, 0.2)
_CUT = 0.85  # of the radius, while the decrease fails
_SMALLEST = 0.01  # of the radius that the limits allow: below it there is no region
_SAFETY = 0.8  # of α
#: Least weight of typical sizes, so that P is positive definite.
_REGULARISATION = 1e-8
#: Slowest mode that counts as decaying: a time constant of 1000 s at 0.1 s.
_LARGEST_MODULUS = 1.0 - 1e-4
_ROUNDING = 1e-9


@dataclass(frozen=True)
class TerminalRegion:
    """Terminal cost ``‖L ξ‖²`` and region ``‖L ξ‖² ≤ α`` of a target, with the local law."""

    #: (n_u, n) array; K: ``u = u_s + K ξ``, with n the full state's and the inputs' number
    gain: FloatArray
    root: FloatArray  #: (n, n) array; L, upper triangular, ``P = Lᵀ L``
    level: float  #: α, after the safety factor
    limits_level: float  #: The α that inputs, rates and soft limits alone would allow


class RegionDesign:
    """Regions of one horizon, target by target.

    ``horizon``: its model, weights and soft limits are used, not its length. ``largest_moves``:
    (n_u,); largest change of an input in one control period, V. ``weight``: of all states and
    inputs in the local law's cost, relative to the objective's. ``decay``: share of the slowest
    mode's decay that V keeps back for the nonlinearity, in [0, 1).
    """

    def __init__(
        self, horizon: Horizon, largest_moves: FloatArray, weight: float, decay: float
    ) -> None:
        from scipy import linalg

        self._linalg = linalg  # imported before the first sample, not at it
        discrete, model = horizon.discrete, horizon.model
        self._horizon, self._decay, self._largest_moves = horizon, decay, largest_moves
        self._n, self._n_u = discrete.n_x + model.n_u, model.n_u
        self._lower, self._upper = model.input_bounds()
        self._slopes = BufferedFunction(discrete.slopes("region_slopes"))
        gap = self._gap_function()
        shared = [False, *[True] * (gap.n_in() - 1)]
        self._gap = BufferedFunction(gap.map(_DIRECTIONS, shared, [False]))
        inputs = np.maximum(self._upper, 1e-3)
        sizes = np.concatenate([horizon.scale, np.ones(discrete.n_x - model.n_x), inputs])
        weighted = [
            horizon.weights.states[name] * horizon.scale[model.state_index(name)] ** 2
            for name in horizon.weighted
        ]
        more = weight * float(np.mean(weighted)) if weighted else weight
        self._more_in_state = (more + _REGULARISATION) / sizes**2
        self._more_in_state[discrete.n_x :] = _REGULARISATION / inputs**2
        self._more_in_input = more / inputs**2 + _REGULARISATION
        self._directions = _unit(_drawn(self._n, 0))
        self._jitter = [_drawn(self._n, i) for i in range(1, _ROUNDS + 1)]

    def centre(self, target: Target) -> FloatArray:
        """Full state (its memory at rest under u_s) and input of a target, shape (n,)."""
        step, n_x = self._slopes, self._horizon.model.n_x
        full = np.zeros(self._n - self._n_u)
        full[:n_x] = target.x
        for _ in range(1000):
            before = full[n_x:].copy()
            after = step.evaluate(
                full, target.u, self._horizon.arguments["p"], np.zeros(self._horizon.model.n_w)
            )[0]
            full[n_x:] = after[n_x:]
            if np.array_equal(before, full[n_x:]):
                break
        return np.concatenate([full, target.u])

    def at(self, centre: FloatArray, disturbance: FloatArray) -> TerminalRegion | None:
        """The region around a target, or None where there is none.

        ``centre``: (n,) array; from :meth:`centre`. ``disturbance``: (n_w,) array.
        """
        with warnings.catch_warnings():
            # Of poor conditioning: whether the law is any good is judged by what follows.
            warnings.simplefilter("ignore", self._linalg.LinAlgWarning)
            law = self._local_law(centre, disturbance)
        if law is None:
            return None
        gain, cost = law
        try:
            root = np.asarray(np.linalg.cholesky(cost).T, dtype=np.float64)
        except np.linalg.LinAlgError:
            return None
        allowed = self._level_within_limits(gain, root, centre)
        if not allowed > 0.0:
            return None
        radius = self._radius_of_decrease(gain, root, centre, disturbance, np.sqrt(allowed))
        if radius is None:
            return None
        return TerminalRegion(gain, root, _SAFETY * radius**2, allowed)

    def _local_law(
        self, centre: FloatArray, disturbance: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """K and P, or None where the linearisation cannot be stabilised."""
        linalg = self._linalg
        n_u, n = self._n_u, self._n
        n_full = n - n_u
        _, a, b = self._slopes.evaluate(
            centre[:n_full], centre[n_full:], self._horizon.arguments["p"], disturbance
        )
        b = b.reshape(n_full, n_u)
        A, B = np.zeros((n, n)), np.vstack([b, np.eye(n_u)])
        A[:n_full, :n_full] = a
        in_state, in_input = self._stage_rows(a, b)
        Q = in_state.T @ in_state + np.diag(self._more_in_state)
        R = in_input.T @ in_input + np.diag(self._more_in_input)
        S = in_state.T @ in_input
        if not (np.isfinite(A).all() and np.isfinite(B).all()):
            return None
        try:
            P = linalg.solve_discrete_are(A, B, Q, R, s=S)
        except (linalg.LinAlgError, ValueError):
            return None
        gain = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + S.T)
        closed = A + B @ gain
        slowest = float(np.abs(np.linalg.eigvals(closed)).max())
        if not slowest < _LARGEST_MODULUS:
            return None
        kappa = self._decay * (1.0 - slowest**2)
        stage = Q + S @ gain + gain.T @ S.T + gain.T @ R @ gain
        cost = linalg.solve_discrete_lyapunov(closed.T / np.sqrt(1.0 - kappa), stage)
        return gain, 0.5 * (cost + cost.T)

    def _stage_rows(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Roots of the stage cost: ``‖G_ξ ξ + G_v (u − u_s)‖²``."""
        horizon, n_u = self._horizon, self._n_u
        model, weights = horizon.model, horizon.weights
        inputs = names(model.inputs)
        n_full = len(a)
        in_state, in_input = [], []

        def row(x: FloatArray, last: FloatArray, u: FloatArray, weight: float) -> None:
            in_state.append(np.sqrt(weight) * np.concatenate([x, last]))
            in_input.append(np.sqrt(weight) * u)

        none = np.zeros(n_u)
        for name in horizon.weighted:
            i = model.state_index(name)
            row(a[i], none, b[i], weights.states[name])
        period = horizon.discrete.step_length
        for name in horizon.damped:
            i = model.state_index(name)
            row((a[i] - np.eye(n_full)[i]) / period, none, b[i] / period, weights.rates[name])
        for j, name in enumerate(inputs):
            unit = np.eye(n_u)[j]
            row(np.zeros(n_full), none, unit, weights.inputs.get(name, 0.0))
            row(np.zeros(n_full), -unit, unit, weights.moves.get(name, 0.0))
        return np.array(in_state), np.array(in_input)

    def _level_within_limits(self, gain: FloatArray, root: FloatArray, centre: FloatArray) -> float:
        """α at which the first limit is touched: ``max |gᵀξ| = √α ‖L⁻ᵀ g‖`` on the ellipsoid."""
        horizon, n_u = self._horizon, self._n_u
        rows, rooms = [], []
        u_s = centre[-n_u:]
        for j in range(n_u):
            rows.append(gain[j])
            rooms.append(min(self._upper[j] - u_s[j], u_s[j] - self._lower[j]))
            if np.isfinite(self._largest_moves[j]):
                move = gain[j].copy()
                move[self._n - n_u + j] -= 1.0
                rows.append(move)
                rooms.append(self._largest_moves[j])
        for name in horizon.limited:
            i = horizon.model.state_index(name)
            lower, upper = horizon.soft_limits.states[name]
            rows.append(np.eye(self._n)[i])
            rooms.append(min(upper - centre[i], centre[i] - lower))
        widths = np.linalg.norm(np.linalg.solve(root.T, np.array(rows).T), axis=0)
        room = np.array(rooms)
        if (room <= 0.0).any():
            return 0.0
        return float(np.min(room / np.maximum(widths, 1e-300))) ** 2

    def _radius_of_decrease(
        self,
        gain: FloatArray,
        root: FloatArray,
        centre: FloatArray,
        disturbance: FloatArray,
        largest: float,
    ) -> float | None:
        """The largest radius √α found at which V falls by the stage cost everywhere inside."""
        for array, value in zip(
            self._gap.inputs[1:],
            (root, np.linalg.inv(root), centre, gain, self._horizon.arguments["p"], disturbance),
            strict=True,
        ):
            array[...] = value
        radius = largest
        while radius >= _SMALLEST * largest:
            if self._falls(radius):
                return radius
            radius *= _CUT
        return None

    def _falls(self, radius: float) -> bool:
        """Whether the decrease holds on all shells, around their worst directions too."""
        directions = self._directions
        for share in _SHELLS:
            gaps = self._gaps(share * radius, directions)
            if gaps.max() > _ROUNDING:
                return False
        gaps = self._gaps(radius, directions)
        spread = 0.5
        for jitter in self._jitter:
            worst = directions[:, np.argsort(gaps)[-_WORST:]]
            around = np.repeat(worst, _DIRECTIONS // _WORST, axis=1)
            around = _unit(around + spread / np.sqrt(self._n) * jitter)
            around[:, :_WORST] = worst
            directions, gaps = around, self._gaps(radius, around)
            if gaps.max() > _ROUNDING:
                return False
            spread *= 0.6
        return True

    def _gaps(self, radius: float, directions: FloatArray) -> FloatArray:
        """(V(ξ⁺) − V(ξ) + stage cost)/V(ξ) at radius times each direction, (n_directions,)."""
        self._gap.inputs[0][...] = radius * directions
        self._gap()
        gaps = self._gap.outputs[0].ravel()
        return np.where(np.isfinite(gaps), gaps, np.inf)

    def _gap_function(self) -> ca.Function:
        """The same of one point ``ξ = L⁻¹ ζ``, the nonlinear model's next state inside."""
        horizon, n, n_u = self._horizon, self._n, self._n_u
        model, weights, discrete = horizon.model, horizon.weights, horizon.discrete
        n_full = n - n_u
        zeta = ca.SX.sym("zeta", n)
        root, inverse = ca.SX.sym("root", n, n), ca.SX.sym("inverse", n, n)
        centre, gain = ca.SX.sym("centre", n), ca.SX.sym("gain", n_u, n)
        _, _, p, w = discrete.symbols()
        xi = inverse @ zeta
        full, last, move = centre[:n_full] + xi[:n_full], xi[n_full:], gain @ xi
        after = discrete.step(full, centre[n_full:] + move, p, w)
        stage = ca.SX(0)
        for name in horizon.weighted:
            i = model.state_index(name)
            stage += weights.states[name] * (after[i] - centre[i]) ** 2
        for name in horizon.damped:
            i = model.state_index(name)
            stage += weights.rates[name] * ((after[i] - full[i]) / discrete.step_length) ** 2
        for j, name in enumerate(names(model.inputs)):
            stage += weights.inputs.get(name, 0.0) * move[j] ** 2
            stage += weights.moves.get(name, 0.0) * (move[j] - last[j]) ** 2
        following = ca.vertcat(after - centre[:n_full], move)
        value_after = ca.sumsqr(root @ following)
        value = ca.sumsqr(zeta)
        gap = (value_after - value + stage) / value
        return ca.Function("region_gap", [zeta, root, inverse, centre, gain, p, w], [gap])


def _drawn(n: int, round_number: int) -> FloatArray:
    """Numbers that are the same everywhere and about normal, (n, n_directions).

    Sums of four uniform ones by SplitMix64 (Steele, Lea & Flood 2014, OOPSLA) of their position.
    """
    size = n * _DIRECTIONS
    position = np.arange(4 * size * round_number, 4 * size * (round_number + 1), dtype=np.uint64)
    x = (position + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x ^= x >> np.uint64(31)
    uniform = (x >> np.uint64(11)).astype(np.float64) / 2.0**53
    return np.asarray(uniform.reshape(_DIRECTIONS, n, 4).sum(axis=2).T - 2.0)


def _unit(columns: FloatArray) -> FloatArray:
    return np.asarray(columns / np.linalg.norm(columns, axis=0))
