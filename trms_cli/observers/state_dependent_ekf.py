"""State-dependent extended Kalman filter: a Kalman filter in state-dependent coefficients.

    Δx⁺ = Φ(x̂) Δx̂ + Γ_u(x̂, u) Δu + Γ_w(x̂, u) w + c        P⁻ = Φ(x̂) P Φ(x̂)ᵀ + Q

The model is written as a linear one whose matrices depend on the state, exactly, and both mean and
covariance are propagated with these matrices, frozen over a sample: no Jacobian is taken. After A.
Rahideh, "Model identification and robust nonlinear model predictive control of a twin rotor MIMO
system", 2009, chapter 7; the form itself: Mracek, Cloutier & D'Souza 1996, "A new technique for
nonlinear estimation", CCA.

Φ is no derivative: where the coefficients change with the state (the thrust k|ω|·ω has half the
slope that it should), the covariance believes in another spread than the model's. That is what
sets this filter apart from the extended one, for better or worse.

The memory of an input path, sensors that remember and impulses (set-valued friction, stops) are no
part of the form; they act before and after it, and enter the covariance by their own slopes.

The state-dependent coefficients: around an origin (x₀, u₀), with Δx = x − x₀ and Δu = u − u₀,

    f(x, u, p, w) = f(x₀, u₀, p, 0) + A(x) Δx + B(x, u) Δu + G(x, u) w
    A(x)    = ∫₀¹ ∂f/∂x (x₀ + λ Δx, u₀, p, 0) dλ
    B(x, u) = ∫₀¹ ∂f/∂u (x, u₀ + λ Δu, p, 0) dλ
    G(x, u) = ∫₀¹ ∂f/∂w (x, u, p, λ w) dλ      (at w = 0: models are linear in their torques)

the mean-value form of Hadamard's lemma. With several states such a form is not unique (Çimen 2008,
"State-dependent Riccati equation control: a survey", IFAC World Congress); this one needs no hand
and holds for every model, is the Jacobian where x = x₀, and keeps the structure of the equations:
a thrust k ω|ω| becomes k|ω| times ω for an origin at ω₀ = 0, gravity G sin Δα becomes
G (sin Δα/Δα) Δα without a division by zero.

The integrals are Gauss–Legendre sums: exact for polynomials up to degree 2·nodes, so for thrusts
and drags. Of the inertia, which goes by sines and cosines of the pitch, six nodes leave up to 2e-6
of the largest rate at the ends of the rig's travel, and twelve nothing but rounding. A ray that
crosses ω = 0, where ω|ω| has a kink, leaves more.

In time steps of length T the coefficients are frozen,

    Δx⁺ = Φ Δx + T φ₁ (B Δu + G w + f₀)      Φ = I + A T φ₁(A T)

with φ₁ the series of (eᶻ − 1)/z to fourth order, or, for a stiff model, the L-stable Padé
approximation (I − z + z²/2)⁻¹(I − z/2). The coefficients move during a step: this is of first order
in T, where the integrators of :mod:`trms_cli.models.discretisation` are of third and fourth.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray, gauss_legendre
from trms_cli.core.errors import ModelError
from trms_cli.core.plugins import require_known
from trms_cli.core.process_cache import call_memoised
from trms_cli.models.discretisation import factorise_matrix
from trms_cli.models.model import Model, Signal, names
from trms_cli.observers.augmentation import Augmentation, AugmentedModel
from trms_cli.observers.kalman_step import exact_measurement, kalman_step
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import RecursiveFilter

_NODES = 6


@dataclass(frozen=True)
class StateDependentForm:
    """A model around an origin, as expressions."""

    model: Model
    origin_x: FloatArray  #: (n_x,) array
    origin_u: FloatArray  #: (n_u,) array
    #: ``(x, u, p) → A (n_x, n_x), B (n_x, n_u), G (n_x, n_w), f0 (n_x,)``: of the derivative, or,
    #: for a model that only steps, of its step (f0 then is F(x₀, u₀, p, 0) − x₀)
    coefficients: ca.Function
    stepped: bool  #: Whether the coefficients are those of a step of ``model.sample_time``

    def discrete(self, step_length: float) -> ca.Function:
        """``(x, u, p) → Φ (n_x, n_x), Γ_u (n_x, n_u), Γ_w (n_x, n_w), c (n_x,)`` of one step.

        ``Δx⁺ = Φ Δx + Γ_u Δu + Γ_w w + c``, the coefficients frozen at x and u.

        ``step_length``: s; for a model that only steps, its own sample time. Raises ModelError for
        another step of a model that only steps, or one that is not positive.
        """
        model = self.model
        _check_step(model, step_length)
        x, u, p, _ = model.symbols()
        A, B, G, f0 = self.coefficients(x, u, p)
        if self.stepped:
            results = [A, B, G, f0]
        else:
            phi_1 = step_length * _phi_1(A * step_length, model.stiff)
            Phi = ca.SX.eye(model.n_x) + A @ phi_1
            results = [Phi, phi_1 @ B, phi_1 @ G, phi_1 @ f0]
        return ca.Function(
            "state_dependent_step",
            [x, u, p],
            ca.cse([ca.densify(result) for result in results]),
            ["x", "u", "p"],
            ["Phi", "Gamma_u", "Gamma_w", "c"],
        )


def state_dependent(
    model: Model,
    origin_x: FloatArray | None = None,
    origin_u: FloatArray | None = None,
    *,
    nodes: int = _NODES,
) -> StateDependentForm:
    """The state-dependent form of a model around an origin.

    ``model``: its derivative is used, or its step if it only steps; input paths with memory,
    sensors and impulses are not part of it. ``origin_x``: (n_x,); rest by default. ``origin_u``:
    (n_u,); zero by default. ``nodes``: of the Gauss–Legendre sums. Raises ModelError for an origin
    of another size, or without nodes.
    """
    x_0 = np.asarray(model.rest() if origin_x is None else origin_x, dtype=float)
    u_0 = np.zeros(model.n_u) if origin_u is None else np.asarray(origin_u, dtype=float)
    if x_0.shape != (model.n_x,) or u_0.shape != (model.n_u,) or nodes < 1:
        raise ModelError(
            f"an origin of {x_0.size} states and {u_0.size} inputs with {nodes} nodes given",
            remedy=f"model {model.name!r} has {model.n_x} states and {model.n_u} inputs",
        )
    x, u, p, w = model.symbols()
    follow = _equations(model)(x, u, p, w)
    slope_x, slope_u, slope_w = (
        ca.Function(f"slope_{name}", [x, u, p, w], [ca.jacobian(follow, v)])
        for name, v in (("x", x), ("u", u), ("w", w))
    )
    no_w = ca.SX.zeros(model.n_w)
    A, B = ca.SX(model.n_x, model.n_x), ca.SX(model.n_x, model.n_u)
    for place, weight in zip(*gauss_legendre(nodes), strict=True):
        A += weight * slope_x(x_0 + place * (x - x_0), u_0, p, no_w)
        B += weight * slope_u(x, u_0 + place * (u - u_0), p, no_w)
    at_origin = ca.Function("at_origin", [x, u, p, w], [follow])(x_0, u_0, p, no_w)
    f0 = at_origin - x_0 if model.sample_time is not None else at_origin
    coefficients = ca.Function(
        "state_dependent",
        [x, u, p],
        ca.cse([ca.densify(part) for part in (A, B, slope_w(x, u, p, no_w), f0)]),
        ["x", "u", "p"],
        ["A", "B", "G", "f0"],
    )
    return StateDependentForm(model, x_0, u_0, coefficients, model.sample_time is not None)


def _equations(model: Model) -> ca.Function:
    """``(x, u, p, w)`` → the derivative, or the step of a model that only steps."""
    at = model.symbols()
    follow = model.dynamics if model.sample_time is None else model.transition
    return ca.Function("equations", list(at), [follow(*at)])


def _phi_1(z: ca.SX, stiff: bool) -> ca.SX:
    """φ₁(z) = (eᶻ − 1)/z of a matrix, without a division by it."""
    unit = ca.SX.eye(z.shape[0])
    if stiff:
        denominator = unit - z + z @ z / 2.0
        right = ca.densify(unit - z / 2.0)
        solve = factorise_matrix(denominator)
        return ca.horzcat(*(solve(right[:, i]) for i in range(z.shape[0])))
    # Horner: 1 + z/2 (1 + z/3 (1 + z/4))
    return unit + z / 2.0 @ (unit + z / 3.0 @ (unit + z / 4.0))


def _check_step(model: Model, step_length: float) -> None:
    if not step_length > 0:
        raise ModelError(f"a step of {step_length!r} s given", remedy="a time above 0 s")
    own = model.sample_time
    if own is not None and abs(own - step_length) > 1e-9 * own:
        raise ModelError(
            f"model {model.name!r} steps by {own:g} s, and its state-dependent form with it; "
            f"{step_length:g} s asked for",
            where="model",
            remedy=f"set the sample time to {own:g} s, or choose a model with equations",
        )


@dataclass(frozen=True, kw_only=True)
class StateDependentEkf(RecursiveFilter):
    """State-dependent extended Kalman filter; other fields are those of
    :class:`trms_cli.observers.augmentation.FilterOptions`.
    """

    #: State that the coefficients are taken around, by name, rad, rad/s or A; zero for what is not
    #: named
    origin: Mapping[str, float] = field(default_factory=dict)
    #: Command there, by input, V; zero for what is not named
    origin_command: Mapping[str, float] = field(default_factory=dict)

    def compose(
        self, setup: ObserverSetup, augmented: Augmentation
    ) -> tuple[ca.Function, FloatArray]:
        model = augmented.model
        x_0 = _vector(self.origin, model.states, "origin")
        u_0 = _vector(self.origin_command, model.inputs, "origin_command")
        return call_memoised(_step, augmented.alone(), x_0, u_0), model.parameters.values


def _step(augmented: AugmentedModel, x_0: FloatArray, u_0: FloatArray) -> ca.Function:
    return kalman_step(
        "state_dependent_ekf_step",
        augmented,
        state_dependent_transition(augmented, x_0, u_0),
        exact_measurement(augmented),
    )


def state_dependent_transition(
    augmented: AugmentedModel, x_0: FloatArray, u_0: FloatArray
) -> ca.Function:
    """``(z, memory, u, p, w_known) → z⁺, A, memory⁺`` in coefficients around (x₀, u₀).

    Each substep has its own coefficients.
    """
    model, length = augmented.model, augmented.discrete.step_length
    n_x, n_s = model.n_x, augmented.n_s
    substeps = augmented.substeps
    form = state_dependent(model, x_0, u_0).discrete(length / substeps)
    z, memory, u, p, w_known = augmented.symbols()
    state, remembered, slope = z, memory, ca.SX.eye(augmented.n)
    for k in range(substeps):
        window = (k / substeps, (k + 1) / substeps)
        arriving, remembered = model.input_path(remembered, u, p, window, length)
        at = ca.SX.sym("at", augmented.n)
        x, sensor_states = at[:n_x, 0], at[n_x:n_s, 0]
        x_next = ca.SX.sym("moved", n_x)
        w = augmented.torques(at, w_known)
        landed = x_next
        if model.sample_time is None:
            landed = model.impulse(x_next, arriving, p, w, length / substeps)
        if augmented.discrete.n_sensors:
            sensor_states = model.sensor_path(sensor_states, x, landed, arriving, p, window, length)
        after = ca.vertcat(landed, sensor_states, at[n_s:, 0])
        Phi, Gamma_u, Gamma_w, c = form(x, arriving, p)
        linear = x_0 + Phi @ (x - x_0) + Gamma_u @ (arriving - u_0) + Gamma_w @ w + c
        through = ca.horzcat(Phi, ca.SX(n_x, n_s - n_x), Gamma_w[:, augmented.equations])
        one = ca.jacobian(after, at) + ca.jacobian(after, x_next) @ through
        following, one = ca.substitute([after, one], [x_next], [linear])
        following, one = ca.substitute([following, one], [at], [state])
        state, slope = following, one @ slope
    return ca.Function(
        "transition",
        [z, memory, u, p, w_known],
        [ca.densify(result) for result in ca.cse([state, slope, remembered])],
    )


def _vector(values: Mapping[str, float], signals: tuple[Signal, ...], key: str) -> FloatArray:
    signal_names = names(signals)
    for name in values:
        require_known(name, signal_names, f"the model has no {name!r}", f"observer.{key}")
    return np.array([values.get(name, 0.0) for name in signal_names])
