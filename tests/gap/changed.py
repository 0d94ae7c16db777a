"""Recordings of simulated rigs on which something begins."""

from collections.abc import Mapping

import numpy as np

from experiments.gap.blind.drivers import rich_excitation
from tests.identification.greybox.rigs import dataset_of, sensed
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import extend_model
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.simulation.rollout import Rollout

from .recorded import STEP


def begins(
    effects: Mapping[str, Effect],
    onset: float,
    *,
    always: Mapping[str, Effect] | None = None,
    values: Mapping[str, float] | None = None,
    seconds: float = 40.0,
    seed: int = 1,
    precise: bool = False,
    ends: bool = False,
) -> Dataset:
    """A recording in open loop on which effects act from ``onset`` (s) on, others ``always``.

    With an onset of zero they act before the first sample, too. ``precise``: encoders of a
    thousandth of the usual step, with tachos to match. ``ends``: they act until then, and not from
    then on.
    """
    if onset <= 0:
        always, effects = {**(always or {}), **effects}, {}
    before, after = (
        extend_model(Newtonian(), e) for e in (dict(always or {}), {**(always or {}), **effects})
    )
    if ends:
        before, after = after, before
    for rig in (before, after):
        rig.parameters = rig.parameters.replaced(dict(values or {}))
    count, settling = round(seconds / STEP), round(10.0 / STEP)
    cut = max(1, round(onset / STEP)) if onset > 0 else count
    commands = 0.7 * rich_excitation([seed], count, STEP)[0]
    commands[:, 0] += 0.35
    settling_commands = np.repeat(commands[:1], settling, axis=0)
    first = Rollout(before, STEP)
    start = first.initial(before.rest(), commands[0])
    both = np.vstack([settling_commands, commands])
    y, ends = first.outputs(both, [0], [settling + cut], start[None])
    parts = [y[settling:]]
    if cut < count:
        second = Rollout(after, STEP)
        state = _joined(after, before, second, ends[0], commands[cut])
        parts.append(second.outputs(commands, [cut], [count - cut], state[None]).y)
    random = np.random.default_rng(seed)
    if precise:
        sd = np.array([5e-6, 5e-6, 0.02, 0.02])
        measured = np.vstack(parts) + sd * random.standard_normal((count, 4))
    else:
        measured, sd = sensed(before, np.vstack(parts), random)
    return dataset_of(before, commands, measured, sd, step=STEP)


def _joined(
    after: Model, before: Model, rollout: Rollout, state: np.ndarray, command: np.ndarray
) -> np.ndarray:
    """The state of the changed rig where the other one ended."""
    full = rollout.initial(after.rest(), command)
    full[: before.n_x] = state[: before.n_x]
    return full
