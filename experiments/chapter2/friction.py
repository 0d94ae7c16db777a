"""Friction profiles of the rigs with one axis: torque over rate, and what it does to the motion.

Each rig is a model file beside this module, ``model=FILE`` of any command. Nothing of a friction
law is written here: the torques are read off the model, the viscous one from its equations, the
dry one from the impulse that it gives in a very short time.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from experiments.chapter2.simulation import FloatArray, OpenLoop, Response
from experiments.chapter2.study import HERE, Study, signal, times
from trms_cli.effects.extended_model import ExtendedModel
from trms_cli.effects.model_file import load_model
from trms_cli.models.dry_friction import axis_of, moment_index
from trms_cli.models.model import Model
from trms_cli.models.operating_point import at_command

#: s, in which an impulse is read off: no axis moves.
_INSTANT = 1e-7
#: By freedom: the axis, the letter of its signals, the profiles shown.
AXES = {"vertical": ("pitch", "v"), "horizontal": ("yaw", "h")}
PROFILES = ("viscous", "Coulomb", "stiction")


@dataclass(frozen=True)
class FrictionStudy:
    """One rig with one axis."""

    freedom: str
    angle: str
    rates: FloatArray  #: (n,) array; rad/s
    viscous: FloatArray  #: (n,) array; torque on the axis, N m
    dry: dict[str, FloatArray]  #: dict of str to (n,) array; by profile, besides the viscous, N m
    break_away: dict[str, float]  #: By profile: torque at which an axis at rest begins to turn, N m
    swings: dict[str, Response]  #: Free swing, by profile
    drives: dict[str, Response]  #: A slow sine of the command, by profile
    rests: dict[str, float]  #: s, after which the free swing stands still for good; NaN: never
    #: rad, by which the free swing comes to rest beside the equilibrium
    offsets: dict[str, float]
    command: FloatArray  #: (n,) array; of the slow sine, V


def profiled_model(freedom: str, profile: str) -> Model:
    """A rig with one axis with a part of its friction profile, of :data:`PROFILES`."""
    model = load_model(str(HERE / f"friction_{freedom}.yaml"))
    effect = _effect_of(model)
    absent = {"viscous": {"torque": 0.0}, "Coulomb": {"excess": 0.0}, "stiction": {}}[profile]
    values = {f"{effect}.{size}": value for size, value in absent.items()}
    model.parameters = model.parameters.replaced(values)
    return model


def _effect_of(model: Model) -> str:
    assert isinstance(model, ExtendedModel)
    return model.effect_name


def friction_torques(model: Model, axis: str, rates: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Viscous and dry torque of an axis that turns at some rates, its other states at rest.

    Returns (n,), (n,) in N m.
    """
    at = model.symbols()
    row = model.state_index(axis_of(model, axis).angle.replace("alpha", "S"))
    inertia = ca.Function("J", list(at[:3]), [model.quantities(*at[:3])[f"inertia_{axis}"]])
    slope = ca.Function("f", list(at), [model.dynamics(*at)[row]])
    jump = ca.Function("j", list(at), [model.impulse(*at, _INSTANT)[row]])
    rest, idle = _equilibrium(model), (np.zeros(model.n_u), model.parameters.values)
    no_torque = np.zeros(model.n_w)
    level = float(slope(rest, *idle, no_torque))
    viscous, dry = [], []
    for rate in rates:
        x = rest.copy()
        x[row] = rate
        J = float(inertia(x, *idle))
        viscous.append(J * (float(slope(x, *idle, no_torque)) - level))
        dry.append(J * (float(jump(x, *idle, no_torque)) - rate) / _INSTANT)
    return np.array(viscous), np.array(dry)


def _equilibrium(model: Model) -> FloatArray:
    """Where the axis rests without friction, exactly: a model's own rest is rounded."""
    return at_command(model.without_effects(), np.zeros(model.n_u)).x


def break_away_torque(model: Model, axis: str) -> float:
    """Torque from outside at which an axis at rest begins to turn, by bisection, N m."""
    x, u, p, w = model.symbols()
    index = moment_index(model, axis)
    duration = 1e-4
    moved = x + duration * model.dynamics(x, u, p, w)
    row = model.state_index(axis_of(model, axis).angle.replace("alpha", "S"))
    step = ca.Function("step", [x, u, p, w], [model.impulse(moved, u, p, w, duration)[row]])
    rest, low, high = _equilibrium(model), 0.0, 1.0
    while high - low > 1e-7:
        push = np.zeros(model.n_w)
        push[index] = middle = (low + high) / 2
        still = abs(float(step(rest, np.zeros(model.n_u), model.parameters.values, push)))
        low, high = (middle, high) if still < 1e-10 else (low, middle)
    return high if high > 2e-7 else 0.0


def study_friction(study: Study, freedom: str) -> FrictionStudy:
    """Torques, a free swing and a slow drive by each profile."""
    settings, T = study.friction, study.sample_time
    axis, letter = AXES[freedom]
    models = {profile: profiled_model(freedom, profile) for profile in PROFILES}
    torques = {
        profile: friction_torques(model, axis, settings.rates.values)
        for profile, model in models.items()
    }
    loops = {profile: OpenLoop(model, T, study.substeps) for profile, model in models.items()}
    angle = f"alpha_{letter}"
    still = np.zeros((len(times(settings.swing_duration, T)), 1))
    rest = float(_equilibrium(models["viscous"])[models["viscous"].state_index(angle)])
    start = rest + settings.swing_start[freedom]
    swings = {profile: loop.respond(still, {angle: start}) for profile, loop in loops.items()}
    wave = signal(settings.drive[freedom], f"friction.drive.{freedom}")
    command = wave.sample(times(settings.drive_duration, T))
    drives = {profile: loop.respond(command[:, None]) for profile, loop in loops.items()}
    return FrictionStudy(
        freedom=freedom,
        angle=angle,
        rates=settings.rates.values,
        viscous=torques["viscous"][0],
        dry={profile: torque[1] for profile, torque in torques.items()},
        break_away={p: break_away_torque(model, axis) for p, model in models.items()},
        swings=swings,
        drives=drives,
        rests={p: _standstill(swing.time, swing.outputs[angle]) for p, swing in swings.items()},
        offsets={p: float(swing.outputs[angle][-1]) - rest for p, swing in swings.items()},
        command=command,
    )


def _standstill(time: FloatArray, angle: FloatArray) -> float:
    """s, from when on an angle does not change any more; NaN where it does to the end."""
    moving = np.flatnonzero(np.abs(np.diff(angle)) > 1e-9)
    last = int(moving[-1]) + 1 if moving.size else 0
    return float(time[last]) if last < len(time) - 1 else float("nan")
