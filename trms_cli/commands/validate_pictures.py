"""What the figures of a validation are drawn from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trms_cli.identification.dataset import Dataset
from trms_cli.identification.validation.characteristics import (
    coherence,
    default_length,
    segments_of,
    spectrum,
)
from trms_cli.identification.validation.metrics import rms, rms_interval
from trms_cli.identification.validation.residual_tests import ResidualTest
from trms_cli.identification.validation.validate import ModelValidation, joined
from trms_cli.identification.validation.verdict import p_words
from trms_cli.models.model import names
from trms_cli.reporting.validation_figures import ChannelRun, ErrorGrowth
from trms_cli.reporting.validation_spectra import ChannelSpectra, CorrelationPanel

#: Tests whose correlations are drawn, in order.
_DRAWN = ("auto", "input", "square", "product", "bilinear")


def error_growths(validations: Sequence[ModelValidation]) -> list[ErrorGrowth]:
    """Errors over the time ahead, a channel each."""
    growths = []
    for channel, unit in _channels(validations):
        having = [v for v in validations if channel in names(v.channels)]
        first = having[0]
        longest = first.horizons[-1]
        unchanged = first.pooled(channel, longest, "unchanged")
        ahead = (1 + np.arange(unchanged.shape[1])) * first.sample_time
        growths.append(
            ErrorGrowth(
                channel,
                unit,
                ahead,
                {v.name: _by_column(v.pooled(channel, longest)) for v in having},
                _by_column(unchanged),
                first.noise_sd(channel),
                {v.name: [_point(v, channel, h) for h in v.horizons] for v in having},
            )
        )
    return growths


def _by_column(errors: np.ndarray) -> np.ndarray:
    found = np.array([rms(column) for column in errors.T])
    return np.where(found > 0, found, np.nan)  # no place on a logarithmic axis


def _point(
    validation: ModelValidation, channel: str, horizon: float
) -> tuple[float, float, float, float]:
    interval = rms_interval(validation.sums(channel, horizon), validation.options.seed)
    return horizon, interval.value, interval.lower, interval.upper


def free_run_traces(validations: Sequence[ModelValidation]) -> tuple[float, list[ChannelRun]]:
    """Windows of the longest horizon, one after another through the first recording that has any.

    Returns
    -------
    horizon : float
        s.
    traces : list of ChannelRun
    """
    horizon = validations[0].horizons[-1]
    which = next(i for i, run in enumerate(validations[0].runs) if horizon in run.windows)
    traces = []
    for channel, unit in _channels(validations):
        dataset: Dataset | None = None
        simulated: dict[str, np.ndarray] = {}
        starts: np.ndarray = np.zeros(0)
        for validation in validations:
            own, windows = validation.datasets[which], validation.runs[which].windows[horizon]
            if channel not in windows.channels:
                continue
            dataset = dataset or own
            column = windows.channels.index(channel)
            values = np.full(len(own), np.nan)
            chosen = _one_after_another(windows.first, windows.errors.shape[1])
            for i in chosen:
                at = slice(windows.first[i], windows.first[i] + windows.errors.shape[1])
                values[at] = (windows.measured - windows.errors)[i, :, column]
            simulated[validation.name] = np.where(np.isfinite(values), values, np.nan)
            starts = own.time[windows.first[chosen]]
        if dataset is not None:
            traces.append(
                ChannelRun(channel, unit, dataset.time, dataset.output(channel), simulated, starts)
            )
    return horizon, traces


def _one_after_another(first: np.ndarray, length: int) -> list[int]:
    """Windows that do not overlap, from the first on."""
    chosen: list[int] = []
    for i, begin in enumerate(first):
        if not chosen or begin >= first[chosen[-1]] + length:
            chosen.append(i)
    return chosen


def correlation_rows(validation: ModelValidation) -> dict[str, list[CorrelationPanel]]:
    """Correlations of the linear tests and those of squares and products, by channel.

    Channels of which no test could be made, as in a recording of a few seconds, are left out.
    """
    rows = {}
    for signal in validation.channels:
        tests = [t for t in validation.tests.of(signal.name) if t.kind in _DRAWN]
        tests.sort(key=lambda t: _DRAWN.index(t.kind))
        drawn = [t for t in tests if not np.isnan(t.result.correlations).all()]
        if drawn:
            rows[signal.name] = [_panel(test, validation) for test in drawn]
    return rows


def _panel(test: ResidualTest, validation: ModelValidation) -> CorrelationPanel:
    titles = {
        "auto": "past errors",
        "input": "{}",
        "square": "{}²",
        "product": "{} · {}",
        "bilinear": "past error · {}",
    }
    failed = test.failed(validation.tests.level)
    return CorrelationPanel(
        titles[test.kind].format(*test.inputs),
        test.result.lags * validation.sample_time,
        test.result.correlations,
        test.result.band(),
        failed,
        p_words(None if np.isnan(test.p_holm) else test.p_holm),
    )


def spectra_of(validations: Sequence[ModelValidation]) -> list[ChannelSpectra]:
    """Densities and coherence, a channel each; of free runs that stay finite."""
    first = validations[0]
    length = default_length(min(len(d) for d in first.datasets), first.sample_time)
    step = first.sample_time
    found = []
    for channel, unit in _channels(validations):
        simulated, errors = {}, {}
        density = None
        against = {}
        for validation in validations:
            if channel not in names(validation.channels):
                continue
            error, measured = validation.free_run_errors(channel)
            if not np.all(np.isfinite(error) | np.isnan(measured)):
                continue
            of_error = segments_of(error, step, length)
            if density is None:
                density = spectrum(segments_of(measured, step, length))
                inputs = joined(
                    [
                        d.commands[run.whole.first :]
                        for d, run in zip(validation.datasets, validation.runs, strict=True)
                        if channel in names(d.outputs)
                    ],
                    validation.gap,
                )
                against = {
                    name: coherence(of_error, segments_of(inputs[:, i], step, length))
                    for i, name in enumerate(names(validation.datasets[0].inputs))
                    if np.ptp(inputs[~np.isnan(inputs[:, i]), i]) > 0
                }
            simulated[validation.name] = spectrum(
                segments_of(measured - error, step, length)
            ).density
            errors[validation.name] = spectrum(of_error).density
        if density is None or density.segments == 0 or not density.density.max() > 0:
            continue
        found.append(
            ChannelSpectra(
                channel,
                unit,
                density.frequencies,
                density.density,
                simulated,
                errors,
                (density.lower, density.upper),
                {name: c.squared for name, c in against.items()},
                next((c.by_chance for c in against.values()), np.nan),
            )
        )
    return found


def _channels(validations: Sequence[ModelValidation]) -> list[tuple[str, str]]:
    """Channels that any model has, with their units."""
    found = {signal.name: signal.unit for v in validations for signal in v.channels}
    return list(found.items())
