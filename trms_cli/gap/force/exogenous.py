"""Whether the missing force comes from outside, or is a function of what the rig does.

A flexible regression on angles, rates, rotor speeds, commands, their last 0.3 s and the path of the
angles (hysteresis) predicts the force on blocks that were held out. A draught leaves nothing to
predict; friction, a cable, a thrust curve do.

The states themselves will not do: they contain the response to the force, and so a draught too
could be read off them. What is used instead is the motion without that response, and, since a
strong force of the state changes the motion much, that motion again with a law of the states put in
place of the force. The law comes from the other half of the blocks. Neither knows of a force from
outside. Surrogates with the force's spectrum and random phases (Theiler et al. 1992) say what
chance predicts.

The response to the force comes from the record alone: increments of the states are regressed on
states, commands, some products that the physics has, and the force; linearised along the motion
that regression says how the force's share δ of the motion evolves::

    δ⁺ = (I + A + C ∂g/∂z) δ + B f

A command that follows the states (closed loop) is treated as one of them.

For blocks the leave-one-out formula of linear smoothers holds as it does for samples (Cook &
Weisberg 1982, ch. 3.6): with the hat matrix ``H = Φ(ΦᵀΦ + λ)⁻¹Φᵀ`` and the residuals ``r`` of the
fit to everything, the residuals of block ``b`` when it was left out are ``(I − H_bb)⁻¹ r_b``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray, IntArray
from trms_cli.gap.force.laws import ForceRecord, hysteresis
from trms_cli.models.rig_parts import ANGLES, RATES

#: Ridge penalties, relative to the number of samples; features have unit variance.
PENALTIES = (1e-3, 1e-2, 1e-1)


def held_out_errors(
    features: FloatArray,
    targets: FloatArray,
    block: IntArray,
    penalties: tuple[float, ...] = PENALTIES,
) -> FloatArray:
    """Squared errors by block of the ridge regression that does best over all blocks.

    ``features``, (k, p) array. ``targets``, (k, t) array: each with the penalty that suits it best.
    ``block``, (k,) array of int: rising numbers; each block is left out once. ``penalties``: to
    choose from. Returns (n_blocks, t) array: about the mean of the target over everything.
    """
    spread = features.std(axis=0)
    is_varying = spread > 1e-9
    phi = (features[:, is_varying] - features[:, is_varying].mean(axis=0)) / spread[is_varying]
    y = targets - targets.mean(axis=0)
    edges = [*np.flatnonzero(np.diff(block, prepend=-1)).tolist(), block.size]
    power, directions = np.linalg.eigh(phi.T @ phi)
    scores = phi @ directions
    inner = scores.T @ y
    best = np.empty((0, 0))
    for k, penalty in enumerate(penalties):
        weight = 1.0 / (np.maximum(power, 0.0) + penalty * block.size)
        residual = y - scores @ (weight[:, None] * inner)
        errors = np.empty((len(edges) - 1, y.shape[1]))
        for b, (first, end) in enumerate(pairwise(edges)):
            rows = scores[first:end]
            own = np.eye(end - first) - (rows * weight) @ rows.T
            errors[b] = np.sum(np.linalg.solve(own, residual[first:end]) ** 2, axis=0)
        best = np.where(errors.sum(axis=0) < best.sum(axis=0), errors, best) if k else errors
    return best


#: Share of a command's unexplained increments that the states must explain for a closed loop.
_FEEDBACK = 0.3
#: Spreads of a variable beyond which its response to the force is not believed.
_LARGEST = 3.0


@dataclass(frozen=True, kw_only=True)
class Response:
    """How the variables of a record answer to the force."""

    record: ForceRecord
    motion: FloatArray  #: (k, n) array; in the order of :attr:`ForceRecord.variables`
    steps: FloatArray  #: (k, n, n) array; linearised transition from a sample to the next
    push: FloatArray  #: (n,) array; answer within one step to a force of one

    def undisturbed(self) -> FloatArray:
        """The motion without the force, (k, n); each stretch begins with the measured state."""
        force = self.record.force
        middle = np.append(force[:-1] / 2 + force[1:] / 2, 0.0)
        return self.motion - self._response(lambda i, _: middle[i])

    def governed(
        self, undisturbed: FloatArray, law: Callable[[int, FloatArray], float]
    ) -> FloatArray:
        """The motion, (k, n), if the force followed a law of sample and variables, (n,)."""
        return undisturbed + self._response(lambda i, now: law(i, undisturbed[i] + now))

    def _response(self, force: Callable[[int, FloatArray], float]) -> FloatArray:
        limit = _LARGEST * self.motion.std(axis=0)
        response = np.zeros_like(self.motion)
        for part in self.record.segments:
            now = np.zeros(self.push.size)
            for i in range(part.start, part.stop - 1):
                now = self.steps[i] @ now + self.push * force(i, now)
                now = np.minimum(np.maximum(now, -limit), limit)
                response[i + 1] = now
        return response


def fitted_response(record: ForceRecord) -> Response:
    """Fit the response to the force; the record at about 10 Hz."""
    names = list(record.variables)
    z = np.array([record.variables[name] for name in names]).T
    terms, slopes = _terms(names, z, record.parts.angle(record.parts.tilting))
    starts = np.concatenate([np.arange(p.start, p.stop - 1) for p in record.segments])
    force = record.force[starts] / 2 + record.force[starts + 1] / 2
    increments = z[starts + 1] - z[starts]
    columns = np.column_stack([z[starts], terms[starts], force, np.ones(starts.size)])
    scale = np.sqrt(np.mean(columns**2, axis=0)) + 1e-300
    coefficients = np.linalg.lstsq(columns / scale, increments, rcond=1e-8)[0] / scale[:, None]
    for row, name in enumerate(names):
        if name.endswith("command") and not _follows(names, row, z[starts], increments[:, row]):
            coefficients[:, row] = 0.0
    n, m = len(names), terms.shape[1]
    linear, nonlinear, push = coefficients[:n].T, coefficients[n : n + m].T, coefficients[n + m]
    steps = np.eye(n) + linear + np.einsum("im,kmj->kij", nonlinear, slopes)
    return Response(record=record, motion=z, steps=steps, push=push)


def _terms(names: list[str], z: FloatArray, tilt: str) -> tuple[FloatArray, FloatArray]:
    """Products that the physics has, (k, m), and their derivatives by the variables, (k, m, n).

    ``tilt``: name of the angle that weight depends on.
    """
    values: list[FloatArray] = []
    slopes: list[FloatArray] = []

    def add(column: int, value: FloatArray, slope: FloatArray) -> None:
        values.append(value)
        derivative = np.zeros_like(z)
        derivative[:, column] = slope
        slopes.append(derivative)

    for column, name in enumerate(names):
        v = z[:, column]
        if name.endswith((*RATES, "rotor speed")):
            add(column, v * np.abs(v), 2 * np.abs(v))
        elif name == tilt:
            add(column, np.cos(v), -np.sin(v))
            add(column, np.sin(v), np.cos(v))
    if not values:
        return np.zeros((len(z), 0)), np.zeros((len(z), 0, len(names)))
    return np.array(values).T, np.array(slopes).transpose(1, 0, 2)


def _follows(names: list[str], row: int, z: FloatArray, increments: FloatArray) -> bool:
    """Whether angles and rates decide a command's increments: a loop is closed."""
    motion = [i for i, name in enumerate(names) if name.endswith((*ANGLES, *RATES))]

    def residual_energy(columns: FloatArray) -> float:
        coefficients = np.linalg.lstsq(columns, increments)[0]
        return float(np.sum((increments - columns @ coefficients) ** 2))

    alone = np.column_stack([z[:, row], np.ones(len(z))])
    both = np.column_stack([alone, z[:, motion]])
    return residual_energy(both) < (1 - _FEEDBACK) * residual_energy(alone)


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

    predictable_share: float  #: Of the variance beyond noise, on held-out blocks, 0 to 1
    ci95: tuple[float, float]  #: Bootstrap over blocks
    p_value: float  #: Share of surrogates predicted as well: large for a force from outside
    from_variables: tuple[str, ...]  #: What predicts it, the most telling first; empty for nothing


def exogenous(record: ForceRecord, seed: int = 0) -> Exogenous:
    """Judge whether a force depends on what the rig does.

    ``record``: at least a minute of it; with less little can be predicted from little. ``seed``: of
    random features, surrogates and bootstrap.

    In closed loop the controller's answer to a draught is removed only as far as it is linear in
    angles and rates; the share is then an upper bound. A law that changes with time counts as from
    outside in part: time is no variable of the regression.
    """
    rng = np.random.default_rng(seed)
    record = record.thinned(_RATE)
    variance = float(np.var(record.force))
    if not record.variables or variance == 0 or record.time.size < _FEWEST:
        return Exogenous(predictable_share=0.0, ci95=(0.0, 1.0), p_value=1.0, from_variables=())
    block = record.blocks(_BLOCK)
    if block[-1] < 3:
        block = record.blocks(float(np.ptp(record.time)) / 4)
    targets = np.column_stack([record.force, _surrogates(record, rng)])
    variables = _independent_motion(record, block)
    single = {name: _alone(record, name, values) for name, values in variables.items()}
    features = np.column_stack([*single.values(), _together(variables, rng)])
    errors = held_out_errors(features, targets, block)
    about_mean = np.sum((targets - targets.mean(axis=0)) ** 2, axis=0)
    explained_shares = 1 - errors.sum(axis=0) / about_mean
    chance = max(float(np.median(explained_shares[1:])), 0.0)
    beyond_noise = variance / record.signal_power(variance)
    share = float(np.clip((explained_shares[0] - chance) * beyond_noise, 0.0, 1.0))
    as_good = int(np.sum(explained_shares[1:] >= explained_shares[0]))
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
        lower_values = tables[each, point]
        parts = lower_values + (tables[each, point + 1] - lower_values) * (place - point)
        return float(min(max(offset + parts.sum(), low), high))

    return law


def _smooth(at: FloatArray, values: FloatArray, name: str) -> FloatArray:
    """Columns of smooth functions of one variable, (len(at), p), scaled to its ``values``."""
    spread = float(values.std()) + 1e-12
    centres = np.quantile(values, np.linspace(0.03, 0.97, _BUMPS))
    width = max(float(np.ptp(centres)) / (_BUMPS - 1), 0.05 * spread)
    bumps = np.exp(-0.5 * ((at[:, None] - centres) / width) ** 2)
    columns = [bumps, at[:, None], (at * np.abs(at))[:, None]]
    if not name.endswith(ANGLES):
        # The sign, sharp and less so: what turns with the direction turns within a small range.
        columns.append(np.tanh(at[:, None] / (spread * np.array([0.05, 0.3]))))
    return np.column_stack(columns)


def _alone(record: ForceRecord, name: str, values: FloatArray) -> FloatArray:
    """Smooth functions of one variable, of how it changed, and of its path: (k, p)."""
    columns = [_smooth(values, values, name)]
    if name.endswith(ANGLES):
        columns += [memory[:, None] for memory in hysteresis(record, values)]
    step = float(np.median(np.diff(record.time)))
    for ago in (max(round(_PAST / 2 / step), 1), max(round(_PAST / step), 2)):
        columns.append((values - _earlier(record, values, ago))[:, None])
    return np.column_stack(columns)


def _earlier(record: ForceRecord, values: FloatArray, ago: int) -> FloatArray:
    """Values so many samples before, the first one of a stretch before its start."""
    result = np.empty_like(values)
    for part in record.segments:
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
    for part in record.segments:
        values = record.force[part]
        spectrum = np.abs(np.fft.rfft(values - values.mean()))
        phase = rng.uniform(0, 2 * np.pi, size=(_SURROGATES, spectrum.size))
        surrogates = np.fft.irfft(spectrum * np.exp(1j * phase), values.size, axis=1)
        result[part] = surrogates.T + values.mean()
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
    resamples = rng.integers(0, first.size, size=(400, first.size))
    shares = (
        1 - errors[resamples].sum(axis=1) / total[resamples].sum(axis=1) - chance
    ) * beyond_noise
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
        residual_energy = float(held_out_errors(columns, force, block, penalties=_MIDDLE).sum())
        alone[name] = (1 - residual_energy / total) * beyond_noise
    ranking = sorted(alone, key=lambda name: -alone[name])
    return tuple(name for name in ranking if alone[name] > _TELLING * share)
