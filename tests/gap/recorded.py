"""Recordings of simulated rigs for the tests of the diagnosis, and forces on a rig of few lines."""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.signal import lfilter

from experiments.gap.blind.drivers import rich_excitation
from tests.identification.greybox.rigs import dataset_of, sensed
from trms_cli.composition.catalogue import read_yaml
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import extend_model
from trms_cli.gap.force.laws import ForceRecord
from trms_cli.identification.dataset import Dataset
from trms_cli.models.newtonian import Newtonian
from trms_cli.simulation.rollout import Rollout

STEP = 0.02  # s


def effect(name: str, **sizes: float) -> Effect:
    """An effect of the library, at other sizes."""
    return build(read_yaml(config_folder() / "effect" / f"{name}.yaml")[name] | sizes, name)


def recording(
    effects: Mapping[str, Effect] | None = None,
    *,
    values: Mapping[str, float] | None = None,
    seconds: float = 40.0,
    seed: int = 1,
) -> Dataset:
    """What a rig records in open loop, its sensors as those of the bench."""
    rig = extend_model(Newtonian(), dict(effects or {}))
    if values:
        rig.parameters = rig.parameters.replaced(dict(values))
    count = round(seconds / STEP)
    settling = round(10.0 / STEP)
    commands = 0.7 * rich_excitation([seed], count, STEP)[0]
    commands[:, 0] += 0.35
    settling_commands = np.repeat(commands[:1], settling, axis=0)
    rollout = Rollout(rig, STEP)
    start = rollout.initial(rig.rest(), commands[0])
    y = rollout.outputs(
        np.vstack([settling_commands, commands]), [0], [settling + count], start[None]
    ).y
    measured, sd = sensed(rig, y[settling:], np.random.default_rng(seed))
    return dataset_of(rig, commands, measured, sd, step=STEP)


def coloured(rng: np.random.Generator, samples: int, time: float) -> np.ndarray:
    """Noise of variance one that forgets itself over ``time`` [s]."""
    keep = np.exp(-STEP / time)
    noise = rng.normal(size=samples) * np.sqrt(1 - keep**2)
    noise[0] = rng.normal()
    return lfilter([1], [1, -keep], noise)


INERTIA, DAMPING, STIFFNESS = 0.03, 0.008, 0.015  # kg m², N m s/rad, N m/rad
#: A torque on yaw of (t, angle, rate, pitch, main speed, tail speed), N m.
Law = Callable[[float, float, float, float, float, float], float]


def moved(
    rng: np.random.Generator,
    law: Law | None = None,
    outside: np.ndarray | None = None,
    samples: int = 6000,
    noise: float = 0.2,
    lowest: float = 0.2,
    hold: int = 150,
) -> ForceRecord:
    """A rig that random steps and a torque move; the torque with coloured noise on it.

    It is yaw with a cable and two rotors, and pitch beside it.
    """
    u_h = np.repeat(rng.uniform(-1.5, 1.5, samples // hold + 1), hold)[:samples]
    slower = hold * 4 // 3
    u_v = np.repeat(rng.uniform(lowest, 1.8, samples // slower + 1), slower)[:samples]
    a = r = p = q = wv = wh = 0.0
    rows = np.empty((samples, 7))
    for i in range(samples):
        f = 0.0 if outside is None else float(outside[i])
        if law is not None:
            f += law(i * STEP, a, r, p, wv, wh)
        rows[i] = f, a, r, p, q, wv, wh
        wh += STEP * (u_h[i] * 200 - wh) / 0.3
        wv += STEP * (u_v[i] * 140 - wv) / 0.8
        thrust = 4.2e-7 * wh * abs(wh)
        r += STEP * (thrust * np.cos(p) - DAMPING * r - STIFFNESS * a + f) / INERTIA
        a += STEP * r
        q += STEP * (3.75e-6 * wv * abs(wv) - 0.26 * np.sin(p + 0.62) - 0.02 * q) / 0.07
        p += STEP * q
    sd = noise * np.sqrt(np.mean(rows[:, 0] ** 2))
    return ForceRecord(
        location="yaw_moment",
        unit="N*m",
        time=STEP * np.arange(samples),
        recording=np.zeros(samples, dtype=np.int64),
        force=rows[:, 0] + sd * coloured(rng, samples, 0.1),
        sd=np.full(samples, sd),
        angles={"pitch": rows[:, 3], "yaw": rows[:, 1]},
        rates={"pitch": rows[:, 4], "yaw": rows[:, 2]},
        speeds={"main": rows[:, 5], "tail": rows[:, 6]},
        commands={"main": u_v, "tail": u_h},
    )
