"""Whether the missing force comes from outside, or is a function of what the rig does.

A flexible regression on angles, rates, rotor speeds, commands, their last 0.3 s and the path of the
angles (hysteresis) predicts the force on blocks that were held out. A draught leaves nothing to
predict; friction, a cable, a thrust curve do.

The states themselves will not do: they contain the response to the force, and so a draught too
could be read off them. What is used instead is the motion without that response (see
:mod:`trms_cli.gap.force.response`), and, since a strong force of the state changes the motion much,
that motion again with a law of the states put in place of the force. The law comes from the other
half of the blocks. Neither knows of a force from outside. Surrogates with the force's spectrum and
random phases (Theiler et al. 1992) say what chance predicts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from trms_cli.gap.force.families import hysteresis
from trms_cli.gap.force.held_out import PENALTIES, held_out_errors
from trms_cli.gap.force.record import (
    BoolArray,
    FloatArray,
    ForceRecord,
    IntArray,
    blocks,
    segments,
    signal_power,
    thinned,
)
from trms_cli.gap.force.response import Response, fitted_response

#: Hz, of the regression, and s, of a held-out block.
_RATE, _BLOCK = 6.0, 10.0
#: s, of the past that the force may depend on.
_PAST = 0.3
_SURROGATES = 39
_RANDOM_FEATURES = 64
_BUMPS = 7
_MIDDLE = PENALTIES[1:2]
#: Samples below which nothing is asked.
_FEWEST = 80
#: Ridge penalty of the law that is put in place of the force, relative to the number of samples.
_PENALTY = 1e-2
#: Points at which a law of one variable is tabulated.
_POINTS = 33
#: A variable is named that predicts alone at least this share of what all predict together.
_TELLING = 0.3


@dataclass(frozen=True, kw_only=True)
class Exogenous:
    """How far the rig's own doings predict a force."""

    #: Of the force's variance beyond its noise, on held-out blocks, beyond chance; 0 to 1
    predictable_share: float
    ci95: tuple[float, float]  #: Bootstrap over blocks
    #: Share of surrogates that are predicted as well: large for a force from outside
    p_value: float
    #: What predicts it, the most telling first; empty where nothing does
    from_variables: tuple[str, ...]


def exogenous(record: ForceRecord, seed: int = 0) -> Exogenous:
    """Judge whether a force depends on what the rig does.

    Parameters
    ----------
    record : ForceRecord
        At least a minute of it; with less little can be predicted from little.
    seed : int
        Of random features, surrogates and bootstrap.

    Notes
    -----
    In closed loop the controller's answer to a draught is removed only as far as it is linear in
    angles and rates; the share is then an upper bound. A law that changes with time counts as from
    outside in part: time is no variable of the regression.
    """
    rng = np.random.default_rng(seed)
    record = thinned(record, _RATE)
    variance = float(np.var(record.force))
    if not record.variables or variance == 0 or record.time.size < _FEWEST:
        return Exogenous(predictable_share=0.0, ci95=(0.0, 1.0), p_value=1.0, from_variables=())
    block = blocks(record, _BLOCK)
    if block[-1] < 3:
        block = blocks(record, float(np.ptp(record.time)) / 4)
    targets = np.column_stack([record.force, _surrogates(record, rng)])
    variables = _independent_motion(record, block)
    single = {name: _alone(record, name, values) for name, values in variables.items()}
    features = np.column_stack([*single.values(), _together(variables, rng)])
    errors = held_out_errors(features, targets, block)
    about_mean = np.sum((targets - targets.mean(axis=0)) ** 2, axis=0)
    explained = 1 - errors.sum(axis=0) / about_mean
    chance = max(float(np.median(explained[1:])), 0.0)
    beyond_noise = variance / signal_power(record, variance)
    share = float(np.clip((explained[0] - chance) * beyond_noise, 0.0, 1.0))
    as_good = int(np.sum(explained[1:] >= explained[0]))
    return Exogenous(
        predictable_share=share,
        ci95=_interval(record, errors[:, 0], block, chance, beyond_noise, rng),
        p_value=(1 + as_good) / (1 + _SURROGATES),
        from_variables=_telling(single, targets[:, :1], block, share, beyond_noise),
    )


def _independent_motion(record: ForceRecord, block: IntArray) -> dict[str, FloatArray]:
    """The motion as far as it does not come of a force from outside, by variable."""
    response = fitted_response(record)
    half = block % 2
    laws = [_law(response, half != number) for number in (0, 1)]
    motion = response.governed(response.undisturbed(), lambda i, state: laws[half[i]](state))
    return {name: motion[:, i] for i, name in enumerate(record.variables)}


def _law(response: Response, rows: BoolArray) -> Callable[[FloatArray], float]:
    """A sum of smooth functions of one variable each that fits the force at these samples."""
    motion, force = response.motion, response.record.force
    names = list(response.record.variables)
    columns = [_smooth(v, v, name) for name, v in zip(names, motion.T, strict=True)]
    phi = np.column_stack(columns)
    mean, spread = phi.mean(axis=0), phi.std(axis=0) + 1e-12
    phi = (phi - mean) / spread
    offset = float(force[rows].mean())
    gram = phi[rows].T @ phi[rows] + _PENALTY * rows.sum() * np.eye(phi.shape[1])
    weights = np.linalg.solve(gram, phi[rows].T @ (force[rows] - offset)) / spread
    offset -= float(mean @ weights)
    # Tabulated over each variable's range, since it is asked sample after sample.
    first, last = np.quantile(motion, (0.002, 0.998), axis=0)
    grids = np.linspace(first, last, _POINTS)
    ends = np.cumsum([own.shape[1] for own in columns])
    tables = np.array(
        [
            _smooth(grids[:, i], motion[:, i], name) @ weights[end - columns[i].shape[1] : end]
            for i, (name, end) in enumerate(zip(names, ends, strict=True))
        ]
    )
    per_point = (_POINTS - 1) / (last - first + 1e-12)
    each = np.arange(len(names))
    low, high = np.quantile(force, (0.005, 0.995))

    def law(state: FloatArray) -> float:
        place = np.minimum(np.maximum((state - first) * per_point, 0.0), _POINTS - 1.001)
        point = place.astype(np.int64)
        left = tables[each, point]
        parts = left + (tables[each, point + 1] - left) * (place - point)
        return float(min(max(offset + parts.sum(), low), high))

    return law


def _smooth(at: FloatArray, values: FloatArray, name: str) -> FloatArray:
    """Columns of smooth functions of one variable, (len(at), p), scaled to its ``values``."""
    spread = float(values.std()) + 1e-12
    centres = np.quantile(values, np.linspace(0.03, 0.97, _BUMPS))
    width = max(float(np.ptp(centres)) / (_BUMPS - 1), 0.05 * spread)
    bumps = np.exp(-0.5 * ((at[:, None] - centres) / width) ** 2)
    columns = [bumps, at[:, None], (at * np.abs(at))[:, None]]
    if not name.endswith("angle"):
        # The sign, sharp and less so: what turns with the direction turns within a small range.
        columns.append(np.tanh(at[:, None] / (spread * np.array([0.05, 0.3]))))
    return np.column_stack(columns)


def _alone(record: ForceRecord, name: str, values: FloatArray) -> FloatArray:
    """Smooth functions of one variable, of how it changed, and of its path: (k, p)."""
    columns = [_smooth(values, values, name)]
    if name.endswith("angle"):
        columns += [memory[:, None] for memory in hysteresis(record, values)]
    step = float(np.median(np.diff(record.time)))
    for ago in (max(round(_PAST / 2 / step), 1), max(round(_PAST / step), 2)):
        columns.append((values - _earlier(record, values, ago))[:, None])
    return np.column_stack(columns)


def _earlier(record: ForceRecord, values: FloatArray, ago: int) -> FloatArray:
    """Values so many samples before, the first one of a stretch before its start."""
    result = np.empty_like(values)
    for part in segments(record):
        rows = np.maximum(np.arange(part.start, part.stop) - ago, part.start)
        result[part] = values[rows]
    return result


def _together(variables: dict[str, FloatArray], rng: np.random.Generator) -> FloatArray:
    """Products of pairs, and random Fourier features (Rahimi & Recht 2007) of all together."""
    z = np.array(list(variables.values())).T
    z = (z - z.mean(axis=0)) / (z.std(axis=0) + 1e-12)
    first, second = np.triu_indices(z.shape[1], 1)
    waves = rng.normal(size=(z.shape[1], _RANDOM_FEATURES)) / np.sqrt(z.shape[1])
    phase = rng.uniform(0, 2 * np.pi, _RANDOM_FEATURES)
    return np.column_stack([z[:, first] * z[:, second], np.cos(z @ waves + phase)])


def _surrogates(record: ForceRecord, rng: np.random.Generator) -> FloatArray:
    """Series with the force's spectrum and random phases, (k, surrogates)."""
    result = np.empty((record.time.size, _SURROGATES))
    for part in segments(record):
        values = record.force[part]
        spectrum = np.abs(np.fft.rfft(values - values.mean()))
        phase = rng.uniform(0, 2 * np.pi, size=(_SURROGATES, spectrum.size))
        turned = np.fft.irfft(spectrum * np.exp(1j * phase), values.size, axis=1)
        result[part] = turned.T + values.mean()
    return result


def _interval(
    record: ForceRecord,
    errors: FloatArray,
    block: IntArray,
    chance: float,
    beyond_noise: float,
    rng: np.random.Generator,
) -> tuple[float, float]:
    first = np.flatnonzero(np.diff(block, prepend=-1))
    total = np.add.reduceat((record.force - record.force.mean()) ** 2, first)
    drawn = rng.integers(0, first.size, size=(400, first.size))
    shares = (1 - errors[drawn].sum(axis=1) / total[drawn].sum(axis=1) - chance) * beyond_noise
    low, high = np.quantile(np.clip(shares, 0.0, 1.0), (0.025, 0.975))
    return float(low), float(high)


def _telling(
    single: dict[str, FloatArray],
    force: FloatArray,
    block: IntArray,
    share: float,
    beyond_noise: float,
) -> tuple[str, ...]:
    if share < 0.1:
        return ()
    total = float(np.sum((force - force.mean()) ** 2))
    alone = {}
    for name, columns in single.items():
        left = float(held_out_errors(columns, force, block, penalties=_MIDDLE).sum())
        alone[name] = (1 - left / total) * beyond_noise
    ranked = sorted(alone, key=lambda name: -alone[name])
    return tuple(name for name in ranked if alone[name] > _TELLING * share)
