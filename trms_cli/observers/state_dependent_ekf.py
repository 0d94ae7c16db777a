"""State-dependent extended Kalman filter: a Kalman filter in state-dependent coefficients.

    Δx⁺ = Φ(x̂) Δx̂ + Γ_u(x̂, u) Δu + Γ_w(x̂, u) w + c        P⁻ = Φ(x̂) P Φ(x̂)ᵀ + Q

The model is written as a linear one whose matrices depend on the state, exactly
(:mod:`trms_cli.models.state_dependent`), and both mean and covariance are propagated with these
matrices, frozen over a sample: no Jacobian is taken. After A. Rahideh, "Model identification and
robust nonlinear model predictive control of a twin rotor MIMO system", 2009, chapter 7; the form
itself: Mracek, Cloutier & D'Souza 1996, "A new technique for nonlinear estimation", CCA.

Φ is no derivative: where the coefficients change with the state (the thrust k|ω|·ω has half the
slope that it should), the covariance believes in another spread than the model's. That is what
sets this filter apart from the extended one, for better or worse.

The memory of an input path, sensors that remember and impulses (set-valued friction, stops) are no
part of the form; they act before and after it, and enter the covariance by their own slopes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.core.process_cache import kept
from trms_cli.models.model import Signal, names
from trms_cli.models.state_dependent import state_dependent
from trms_cli.observers.augmentation import Augmentation, AugmentedModel
from trms_cli.observers.kalman_step import exact_measurement, kalman_step
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import RecursiveFilter

FloatArray = npt.NDArray[np.float64]


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
        return kept(_step, augmented.alone(), x_0, u_0), model.parameters.values


def _step(augmented: AugmentedModel, x_0: FloatArray, u_0: FloatArray) -> ca.Function:
    """One sample; see :func:`trms_cli.observers.kalman_step.kalman_step`."""
    return kalman_step(
        "state_dependent_ekf_step",
        augmented,
        state_dependent_transition(augmented, x_0, u_0),
        exact_measurement(augmented),
    )


def state_dependent_transition(
    augmented: AugmentedModel, x_0: FloatArray, u_0: FloatArray
) -> ca.Function:
    """``(z, memory, u, p, known) → z⁺, A, memory⁺`` in coefficients around (x₀, u₀).

    Each substep has its own coefficients.
    """
    model, length = augmented.model, augmented.discrete.step_length
    n_x, n_s = model.n_x, augmented.n_s
    substeps = augmented.substeps
    form = state_dependent(model, x_0, u_0).discrete(length / substeps)
    z, memory, u, p, known = augmented.symbols()
    state, remembered, slope = z, memory, ca.SX.eye(augmented.n)
    for k in range(substeps):
        window = (k / substeps, (k + 1) / substeps)
        arriving, remembered = model.input_path(remembered, u, p, window, length)
        at = ca.SX.sym("at", augmented.n)
        x, shown = at[:n_x, 0], at[n_x:n_s, 0]
        moved = ca.SX.sym("moved", n_x)
        w = augmented.torques(at, known)
        landed = moved
        if model.sample_time is None:
            landed = model.impulse(moved, arriving, p, w, length / substeps)
        if augmented.discrete.n_sensors:
            shown = model.sensor_path(shown, x, landed, arriving, p, window, length)
        after = ca.vertcat(landed, shown, at[n_s:, 0])
        Phi, Gamma_u, Gamma_w, c = form(x, arriving, p)
        linear = x_0 + Phi @ (x - x_0) + Gamma_u @ (arriving - u_0) + Gamma_w @ w + c
        through = ca.horzcat(Phi, ca.SX(n_x, n_s - n_x), Gamma_w[:, augmented.equations])
        one = ca.jacobian(after, at) + ca.jacobian(after, moved) @ through
        following, one = ca.substitute([after, one], [moved], [linear])
        following, one = ca.substitute([following, one], [at], [state])
        state, slope = following, one @ slope
    return ca.Function(
        "transition",
        [z, memory, u, p, known],
        [ca.densify(result) for result in ca.cse([state, slope, remembered])],
    )


def _vector(given: Mapping[str, float], signals: tuple[Signal, ...], key: str) -> FloatArray:
    known = names(signals)
    for name in given:
        if name not in known:
            raise ConfigurationError(
                f"the model has no {name!r}",
                where=f"observer.{key}",
                remedy=nearest(name, known),
            )
    return np.array([given.get(name, 0.0) for name in known])
