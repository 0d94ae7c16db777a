"""Recordings as linear models take them: deviations from an operating point, rows, state spaces.

All computing is done in deviations from the operating point, in units of each signal's spread over
the fitted recordings; what is stored is in the signals' own units. Recordings are taken together:
no row of a regression reaches over their ends, nor over missing samples.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.errors import RecordingError
from trms_cli.core.plugins import require_known
from trms_cli.identification.blackbox.prediction_error import (
    Samples,
    normalised_rms,
    sample_signals,
)
from trms_cli.identification.problem import FitProblem
from trms_cli.models.black_box import ANGLE, remembered_signals
from trms_cli.models.model import Signal, names
from trms_cli.models.state_space import DiscreteStateSpace

#: s of a recording from which the start of its free run is estimated.
START = 2.0
#: A signal whose spread is below this share of its size never moves, rounding apart.
_LEAST_SPREAD = 1e-9
#: s over which the response to an acceleration is looked at.
_RESPONSE = 0.2


@dataclass(frozen=True)
class LinearData:
    """Recordings at a model's sample time, in deviations and units of the spread."""

    output_signals: tuple[Signal, ...]
    input_signals: tuple[Signal, ...]
    sample_time: float  #: s
    output_mean: FloatArray  #: (n_y,), the operating point
    input_mean: FloatArray  #: (n_u,)
    output_sd: FloatArray  #: (n_y,), spread over the fitted recordings
    input_sd: FloatArray  #: (n_u,)
    fitted: tuple[Samples, ...]  #: NaN where a sample is missing
    validation: tuple[Samples, ...]

    @property
    def outputs(self) -> tuple[str, ...]:
        return names(self.output_signals)

    @property
    def inputs(self) -> tuple[str, ...]:
        return names(self.input_signals)

    @property
    def n_y(self) -> int:
        return len(self.output_signals)

    @property
    def n_u(self) -> int:
        return len(self.input_signals)

    @property
    def source(self) -> str:
        """The fitted recordings, for messages."""
        return ", ".join(samples.name for samples in self.fitted)

    def without_block(self, block: int, blocks: int) -> "LinearData":
        """The same with one of so many equal parts of the fitted samples missing."""
        total = sum(len(samples) for samples in self.fitted)
        first, last = (round(total * part / blocks) for part in (block, block + 1))
        parts, begin = [], 0
        for samples in self.fitted:
            outputs = samples.outputs.copy()
            outputs[max(0, first - begin) : max(0, last - begin)] = np.nan
            parts.append(replace(samples, outputs=outputs))
            begin += len(samples)
        return replace(self, fitted=tuple(parts))

    def state_space(
        self,
        A: FloatArray,
        B: FloatArray,
        noise_sd: FloatArray,
        more_states: Sequence[Signal],
        more_scales: FloatArray,
        *,
        more_means: FloatArray | None = None,
    ) -> DiscreteStateSpace:
        """The state space of matrices (n, n), (n, n_u) and noise (n,) in units of the spreads.

        ``more_states``: after the outputs, (n − n_y); ``more_scales``, ``more_means``: their units'
        sizes and operating point; without means they are states of their own that an acceleration
        moves, with means they are remembered signals.
        """
        moved = len(A) if more_means is None else self.n_y
        scale = np.concatenate([self.output_sd, more_scales])
        means = np.zeros(len(more_scales)) if more_means is None else more_means
        return DiscreteStateSpace(
            outputs=self.outputs,
            inputs=self.inputs,
            states=names(more_states),
            output_units=tuple(signal.unit for signal in self.output_signals),
            input_units=tuple(signal.unit for signal in self.input_signals),
            state_units=tuple(signal.unit for signal in more_states),
            sample_time=self.sample_time,
            operating_state=np.concatenate([self.output_mean, means]),
            operating_input=self.input_mean,
            A=scale[:, None] * A / scale,
            B=scale[:, None] * B / self.input_sd,
            E=scale[:, None] * self._accelerations(A, moved) / self.output_sd,
            noise_sd=scale * noise_sd,
        )

    def _accelerations(self, A: FloatArray, moved: int) -> FloatArray:
        """E (n, n_y) with which a unit of w_j accelerates output j alone, as nearly as it can.

        In units of the spreads. After one step of it the angle is at T²/2, T²·3/2, …, a speed stays
        at T, and the other outputs where they are: least squares over the responses of the next
        fifth of a second. What acts is output j and the states after the outputs, up to ``moved``.
        """
        n, n_y, T = len(A), self.n_y, self.sample_time
        count = max(2, round(_RESPONSE / T))
        responses, power = np.empty((count, n_y, n)), np.eye(n)
        for i in range(count):
            responses[i] = power[:n_y]
            power = power @ A
        E = np.zeros((n, n_y))
        for j, signal in enumerate(self.output_signals):
            goal = np.zeros((count, n_y))
            goal[:, j] = T**2 * (np.arange(count) + 0.5) if signal.unit == ANGLE else T
            rows = [j, *range(n_y, moved)] if signal.unit == ANGLE else [j]
            chosen = responses[:, :, rows].reshape(-1, len(rows))
            E[rows, j] = np.linalg.lstsq(chosen, goal.ravel(), rcond=None)[0]
        return E

    def lagged_state_space(
        self, F: FloatArray, G: FloatArray, noise_sd: FloatArray
    ) -> DiscreteStateSpace:
        """The state space of a difference equation ``y(k) = Σ F_l y(k−l) + Σ G_m u(k−m) + e(k)``.

        ``F``: (n_a, n_y, n_y), of the lags 1, 2, …; ``G``: (n_m, n_y, n_u), likewise. ``noise_sd``:
        (n_y,), of e. The state is y(k), y(k−1), … and u(k−1), u(k−2), ….
        """
        n_y, n_u, n_a, n_m = self.n_y, self.n_u, len(F), len(G)
        kept_y, kept_u = n_y * (n_a - 1), n_u * (n_m - 1)
        n = n_y + kept_y + kept_u
        A, B = np.zeros((n, n)), np.zeros((n, n_u))
        A[:n_y, : n_y + kept_y] = np.hstack(list(F))
        B[:n_y] = G[0]
        if kept_u:
            A[:n_y, n_y + kept_y :] = np.hstack(list(G[1:]))
            B[n_y + kept_y : n_y + kept_y + n_u] = np.eye(n_u)
            A[n_y + kept_y + n_u :, n_y + kept_y : n - n_u] = np.eye(kept_u - n_u)
        A[n_y : n_y + kept_y, :kept_y] = np.eye(kept_y)
        result = self.state_space(
            A,
            B,
            np.concatenate([noise_sd, np.zeros(n - n_y)]),
            [
                *remembered_signals(self.output_signals, n_a - 1),
                *remembered_signals(self.input_signals, n_m - 1),
            ],
            np.concatenate([np.tile(self.output_sd, n_a - 1), np.tile(self.input_sd, n_m - 1)]),
            more_means=np.concatenate(
                [np.tile(self.output_mean, n_a - 1), np.tile(self.input_mean, n_m - 1)]
            ),
        )
        # Scales divide out of a copy to rounding only; a copy it must be to the bit.
        exact_A, exact_B = result.A.copy(), result.B.copy()
        exact_A[n_y:], exact_B[n_y:] = A[n_y:], B[n_y:]
        return replace(result, A=exact_A, B=exact_B)


def prepare(
    problem: FitProblem, sample_time: float | None, operating_point: Mapping[str, float]
) -> LinearData:
    """Bring recordings to the form that linear models are fitted to.

    ``sample_time``: s; None: the recordings'. ``operating_point``: by signal, in its unit.

    Raises RecordingError for sample times without a whole ratio, missing channels, inputs or
    outputs that never move; ConfigurationError for an operating point of unknown signals.
    """
    first = problem.datasets[0]
    data = LinearData(
        output_signals=first.outputs,
        input_signals=first.inputs,
        sample_time=float(sample_time or first.sample_time),
        output_mean=np.zeros(len(first.outputs)),
        input_mean=np.zeros(len(first.inputs)),
        output_sd=np.ones(len(first.outputs)),
        input_sd=np.ones(len(first.inputs)),
        fitted=(),
        validation=(),
    )
    raw, raw_validation = (
        [sample_signals(dataset, data, key="method.sample_time") for dataset in datasets]
        for datasets in (problem.datasets, problem.validation)
    )
    for name in operating_point:
        require_known(
            name,
            (*data.outputs, *data.inputs),
            f"no signal is called {name!r}",
            f"method.operating_point.{name}",
        )
    levels: dict[str, tuple[FloatArray, FloatArray]] = {}
    for kind in ("outputs", "inputs"):
        values = np.vstack([getattr(samples, kind) for samples in raw])
        spread = np.nanstd(values, axis=0)
        for name, sd, size in zip(
            getattr(data, kind), spread, np.nanmax(np.abs(values), axis=0), strict=True
        ):
            if not sd > _LEAST_SPREAD * max(1.0, float(size)):
                raise RecordingError(
                    f"{name!r} never moves",
                    where=", ".join(samples.name for samples in raw),
                    remedy="record with an excitation that moves it, for instance a multilevel "
                    "random command (`trms excite`)",
                )
        mean = np.nanmean(values, axis=0)
        for i, name in enumerate(getattr(data, kind)):
            mean[i] = operating_point.get(name, mean[i])
        levels[kind] = (mean, spread)

    def deviations(recordings: Sequence[Samples]) -> tuple[Samples, ...]:
        return tuple(
            Samples(
                (samples.outputs - levels["outputs"][0]) / levels["outputs"][1],
                (samples.inputs - levels["inputs"][0]) / levels["inputs"][1],
                samples.name,
            )
            for samples in recordings
        )

    return replace(
        data,
        output_mean=levels["outputs"][0],
        input_mean=levels["inputs"][0],
        output_sd=levels["outputs"][1],
        input_sd=levels["inputs"][1],
        fitted=deviations(raw),
        validation=deviations(raw_validation),
    )


@dataclass(frozen=True)
class Regression:
    """Rows of a difference equation over all fitted recordings, each with all that it needs."""

    y: FloatArray  #: (n, n_y), what is predicted
    past: FloatArray  #: (n, n_a·n_y), y(k−1), y(k−2), …, all signals of a lag together
    commands: FloatArray  #: (n, n_m·n_u), u(k−1), u(k−2), …
    runs: tuple[slice, ...]  #: Rows that follow each other in time

    def __len__(self) -> int:
        return len(self.y)


def regression(
    data: LinearData, output_lags: int, input_lags: int, first: int | None = None
) -> Regression:
    """The rows that have all of their lags.

    ``first``: samples of each recording that are only looked back to; None: as few as possible.
    """
    first = max(output_lags, input_lags, first or 0)
    parts, places, begin = [], [], 0
    for samples in data.fitted:
        n = len(samples)
        if n <= first:
            continue
        y = samples.outputs[first:]
        past = np.hstack([samples.outputs[first - lag : n - lag] for lag in _to(output_lags)])
        commands = np.hstack([samples.inputs[first - lag : n - lag] for lag in _to(input_lags)])
        there = np.isfinite(np.hstack([y, past, commands])).all(axis=1)
        parts.append((y[there], past[there], commands[there]))
        places.append(begin + np.flatnonzero(there))
        begin += n
    if not parts:
        y, past, commands = (
            np.empty((0, size))
            for size in (data.n_y, data.n_y * output_lags, data.n_u * input_lags)
        )
        return Regression(y, past, commands, ())
    y, past, commands = (np.vstack([part[i] for part in parts]) for i in range(3))
    return Regression(y, past, commands, tuple(_runs(np.concatenate(places))))


def require_rows(data: LinearData, rows: int, regressors: int) -> None:
    """Refuse a regression with fewer than twice as many rows as regressors.

    Raises RecordingError: it says how much to record.
    """
    if rows < 2 * regressors:
        raise RecordingError(
            f"only {rows} complete samples for {regressors} coefficients an output",
            where=data.source,
            remedy=f"record at least {100 * regressors * data.sample_time:.0f} s, or choose lower "
            "orders",
        )


def free_run_error(
    data: LinearData, model: DiscreteStateSpace, recordings: Sequence[Samples]
) -> float:
    """Normalised RMS error of free runs over whole recordings; 1: as good as the mean.

    Each starts from the state that explains its first two seconds best, and counts from their end.
    Infinite after a divergence.
    """
    errors, measured = [], []
    for samples in recordings:
        count = min(max(model.n_x, round(START / data.sample_time)), len(samples) // 2)
        y = samples.outputs * data.output_sd + data.output_mean
        u = samples.inputs * data.input_sd + data.input_mean
        run = model.simulate(model.start_from(y[:count], u[:count]), u)
        errors.append((run - y)[count:])
        measured.append(y[count:])
    return normalised_rms(np.vstack(errors), np.vstack(measured))


def _to(last: int) -> range:
    return range(1, last + 1)


def _runs(places: IntArray) -> Iterator[slice]:
    """Parts of rising indices without a jump."""
    ends = np.flatnonzero(np.diff(places) > 1) + 1
    edges = [0, *ends.tolist(), len(places)]
    for begin, end in pairwise(edges):
        if end > begin:
            yield slice(begin, end)
