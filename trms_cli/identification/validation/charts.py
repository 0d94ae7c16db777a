"""The charts of a validation: free runs, errors by horizon and region, tests, spectra, signals."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from trms_cli.core import wording
from trms_cli.core.chart import CURVES, Axis, Band, Chart, Colour, Curve, Line, Mark, Panel, Points
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.findings import near
from trms_cli.identification.validation import metrics
from trms_cli.identification.validation.residual_tests import ResidualTest, p_words
from trms_cli.identification.validation.validate import ModelValidation, gap_samples, join_parts
from trms_cli.models.model import names

_WIDTH = 9.2
#: Tests whose correlations are drawn, in order, and what stands over each.
_DRAWN = {
    "auto": "past errors",
    "input": "{}",
    "square": "{}²",
    "product": "{} · {}",
    "bilinear": "past error · {}",
}


def _colour(i: int) -> Colour:
    """The colour of the i-th model; more than there are colours share the last."""
    return CURVES[min(i, len(CURVES) - 1)]


def _channels(validations: Sequence[ModelValidation]) -> list[tuple[str, str]]:
    every = {signal.name: signal.unit for v in validations for signal in v.channels}
    return list(every.items())


def growth_chart(validations: Sequence[ModelValidation]) -> Chart:
    """RMS of the error over the time ahead, a panel a channel, both axes logarithmic."""
    panels = []
    for channel, unit in _channels(validations):
        having = [v for v in validations if channel in names(v.channels)]
        first = having[0]
        longest = first.horizons[-1]
        unchanged = first.pooled(channel, longest, "unchanged")
        ahead = (1 + np.arange(unchanged.shape[1])) * first.sample_time
        marks: list[Mark] = [
            Curve(ahead, _by_column(unchanged), "no change", "grey", "dashed", 1.0),
            Line(y=first.noise_sd(channel), label="noise of the sensor"),
        ]
        for validation in having:
            colour = _colour(validations.index(validation))
            errors = _by_column(validation.pooled(channel, longest))
            marks.append(Curve(ahead, errors, validation.name, colour, width=1.3))
            marks += _horizon_points(validation, channel, colour, validations.index(validation))
        y = Axis("RMS of the error", wording.unit(unit), log=True)
        x = Axis("time since the last measurement", "s", log=True)
        panels.append(Panel(x, y, marks, wording.signal(channel)))
    return Chart(
        "growth",
        panels,
        "How the error grows with the time since the last measurement. Lines: at exactly that "
        "time; points: over whole windows, with 95 % intervals.",
        width=_WIDTH / 2,
        height=2.7,
    )


def _by_column(errors: np.ndarray) -> np.ndarray:
    values = np.array([metrics.rms(column) for column in errors.T])
    return np.where(values > 0, values, np.nan)  # no place on a logarithmic axis


def _horizon_points(
    validation: ModelValidation, channel: str, colour: Colour, i: int
) -> list[Mark]:
    """RMS over the whole windows of each horizon, with intervals; models beside one another."""
    rows = [
        (
            horizon * 1.015**i,
            metrics.rms_interval(validation.sums(channel, horizon), validation.options.seed),
        )
        for horizon in validation.horizons
    ]
    x = [place for place, interval in rows if np.isfinite(interval.value)]
    y = [interval.value for _, interval in rows if np.isfinite(interval.value)]
    ends = [(place, own) for place, own in rows if np.isfinite([own.lower, own.upper]).all()]
    whiskers = Curve(
        [value for place, _ in ends for value in (place, place, np.nan)],
        [value for _, own in ends for value in (own.lower, own.upper, np.nan)],
        "",
        colour,
        width=2.2,
    )
    return [whiskers, Points(x, y, "", "dot", colour, size=4.0)]


def free_run_chart(validations: Sequence[ModelValidation]) -> Chart:
    """Windows of the longest horizon one after another through the first recording that has any."""
    horizon = validations[0].horizons[-1]
    which = next(i for i, run in enumerate(validations[0].runs) if horizon in run.windows)
    panels = []
    for channel, unit in _channels(validations):
        dataset: Dataset | None = None
        runs: list[Mark] = []
        errors: list[Mark] = [Line(y=0.0)]
        simulations = []
        starts: np.ndarray = np.zeros(0)
        for i, validation in enumerate(validations):
            own, windows = validation.datasets[which], validation.runs[which].windows[horizon]
            if channel not in windows.channels:
                continue
            dataset = dataset or own
            column = windows.channels.index(channel)
            values = np.full(len(own), np.nan)
            selection = _one_after_another(windows.first, windows.errors.shape[1])
            for k in selection:
                at = slice(windows.first[k], windows.first[k] + windows.errors.shape[1])
                values[at] = (windows.measured - windows.errors)[k, :, column]
            values = np.where(np.isfinite(values), values, np.nan)
            starts = own.time[windows.first[selection]]
            simulations.append(values)
            runs.append(Curve(own.time, values, validation.name, _colour(i), width=0.9))
            error = own.output(channel) - values
            errors.append(Curve(own.time, error, "", _colour(i), width=0.7))
        if dataset is None:
            continue
        time, measured = dataset.time, dataset.output(channel)
        lines = [Line(x=float(start), colour="pale", style="solid") for start in starts]
        marks = [*lines, Curve(time, measured, "measured", "grey", width=2.2), *runs]
        x = Axis("time", "s", (float(time[0]), float(time[-1])))
        unit_label = wording.unit(unit)
        limits = near(measured, simulations, 0.6)
        panels.append(Panel(x, Axis(wording.signal(channel), unit_label, limits), marks))
        panels.append(Panel(x, Axis("error", unit_label), [*lines, *errors], row_height=0.6))
    return Chart(
        "free_runs",
        panels,
        f"Free runs of {horizon:g} s one after another through "
        f"{validations[0].datasets[which].name}; each vertical line begins one.",
        columns=1,
        width=_WIDTH,
        height=1.55,
        together=True,
    )


def _one_after_another(first: np.ndarray, length: int) -> list[int]:
    """Windows that do not overlap, from the first on."""
    selection: list[int] = []
    for i, begin in enumerate(first):
        if not selection or begin >= first[selection[-1]] + length:
            selection.append(i)
    return selection


def region_chart(validations: Sequence[ModelValidation]) -> Chart | None:
    """RMS over each operating variable: a row a channel, a column a variable; None without any."""
    every = [table for validation in validations for table in validation.regions]
    if not every:
        return None
    units = {s.name: s.unit for v in validations for s in (*v.model.inputs, *v.model.outputs)}
    channels = list(dict.fromkeys(table.channel for table in every))
    variables = list(dict.fromkeys(table.variable for table in every))
    highest = {c: max(float(np.nanmax(t.rms)) for t in every if t.channel == c) for c in channels}
    panels = []
    for channel in channels:
        for variable in variables:
            marks: list[Mark] = []
            for i, validation in enumerate(validations):
                for own in validation.regions:
                    if (own.channel, own.variable) == (channel, variable):
                        x, y = _stairs(own.edges, own.rms)
                        label = validation.name if len(validations) > 1 else ""
                        marks.append(Curve(x, y, label, _colour(i)))
                        if not label:
                            marks.append(Band(x, np.zeros(len(x)), y, "", "blue"))
            at = "command " if variable.startswith("u_") else ""
            first = variable == variables[0]
            y_axis = Axis(
                wording.with_unit(wording.signal(channel), units.get(channel, "")) if first else "",
                limits=(0.0, 1.05 * highest[channel] or None),
            )
            last = channel == channels[-1]
            label = wording.with_unit(f"{at}{wording.signal(variable)}", units.get(variable, ""))
            panels.append(Panel(Axis(label if last else ""), y_axis, marks))
    return Chart(
        "regions",
        panels,
        f"RMS over windows of {validations[0].region_horizon:g} s, by where the rig was. A flat "
        "row is an error that is everywhere alike.",
        columns=len(variables),
        width=1.75,
        height=1.5,
    )


def _stairs(edges: Any, values: Any) -> tuple[np.ndarray, np.ndarray]:
    """The outline of bins."""
    return np.repeat(np.asarray(edges, float), 2)[1:-1], np.repeat(np.asarray(values, float), 2)


def correlation_chart(
    validation: ModelValidation, channels: Sequence[str] | None = None
) -> Chart | None:
    """Correlations of the residual tests, a row a channel, a panel a test; None without any."""
    rows: dict[str, list[ResidualTest]] = {}
    for signal in validation.channels:
        tests = [t for t in validation.tests.of(signal.name) if t.kind in _DRAWN]
        tests.sort(key=lambda t: list(_DRAWN).index(t.kind))
        finite_tests = [t for t in tests if not np.isnan(t.result.correlations).all()]
        if finite_tests and (channels is None or signal.name in channels):
            rows[signal.name] = finite_tests
    if not rows:
        return None
    columns = max(len(tests) for tests in rows.values())
    panels = []
    for channel, tests in rows.items():
        for k in range(columns):
            if k >= len(tests):
                panels.append(Panel(Axis(""), Axis(""), []))
                continue
            y_label = wording.signal(channel) if k == 0 else ""
            last = channel == list(rows)[-1]
            panels.append(_correlation_panel(tests[k], validation, y_label, "lag" if last else ""))
    return Chart(
        f"correlations_{wording.file_stem(validation.name)}",
        panels,
        f"{validation.name}: correlations, and the band in which all lags of a right model lie "
        "together with probability 0.95. Red: fails over all tests.",
        columns=columns,
        width=max(1.5, _WIDTH / columns),
        height=1.5,
    )


def _correlation_panel(
    test: ResidualTest, validation: ModelValidation, y_label: str, x_label: str
) -> Panel:
    failed = test.failed(validation.tests.level)
    colour: Colour = "alarm" if failed else "blue"
    lags = test.result.lags * validation.sample_time
    r, band = np.asarray(test.result.correlations), test.result.band()
    reach = 1.25 * float(np.nanmax(np.abs([*r, *band, 1e-3])))
    p = p_words(None if np.isnan(test.p_holm) else test.p_holm)
    marks: list[Mark] = [
        Band(lags, -band, band, "", "grey"),
        Curve(lags, r, "", colour, width=0.6),
        Points(lags, r, "", "dot", colour, size=2.0),
        Line(y=0.0),
    ]
    title = f"{_DRAWN[test.kind].format(*test.inputs)}\n{p}"
    return Panel(
        Axis(x_label, "s" if x_label else ""), Axis(y_label, limits=(-reach, reach)), marks, title
    )


def spectra_chart(validations: Sequence[ModelValidation]) -> Chart | None:
    """A row a channel: densities, and the coherence of the error with the inputs; or None.

    Of free runs that stay finite.
    """
    first = validations[0]
    length = metrics.default_length(min(len(d) for d in first.datasets), first.sample_time)
    step = first.sample_time
    panels: list[Panel] = []
    for channel, unit in _channels(validations):
        density = None
        marks: list[Mark] = []
        against: dict[str, Any] = {}
        for i, validation in enumerate(validations):
            if channel not in names(validation.channels):
                continue
            error, measured = validation.free_run_errors(channel)
            if not np.all(np.isfinite(error) | np.isnan(measured)):
                continue
            of_error = metrics.segments_of(error, step, length)
            if density is None:
                density = metrics.spectrum(metrics.segments_of(measured, step, length))
                against = _coherences(validation, channel, of_error, length)
            f = density.frequencies
            run = metrics.spectrum(metrics.segments_of(measured - error, step, length)).density
            marks.append(Curve(f, run, validation.name, _colour(i), width=0.9))
            density_of_error = metrics.spectrum(of_error).density
            label = f"error of {validation.name}"
            marks.append(Curve(f, density_of_error, label, _colour(i), "dotted", 0.9))
        if density is None or density.segments == 0 or not density.density.max() > 0:
            continue
        f, power = density.frequencies, density.density
        behind: list[Mark] = [
            Band(f, power * density.lower, power * density.upper, "", "grey"),
            Curve(f, power, "measured", "grey", width=2.0),
        ]
        squared = f"({unit})²/Hz" if "/" in unit else f"{unit}²/Hz"
        # what a model without noise lacks at high frequencies shall not flatten the rest
        limits = (0.03 * float(np.nanmin(power[power > 0])), None)
        x = Axis("frequency", "Hz", log=True)
        y = Axis(wording.signal(channel), squared, limits, log=True)
        panels.append(Panel(x, y, [*behind, *marks]))
        curves: list[Mark] = [
            Curve(f, c.squared, name, colour, width=0.8)
            for colour, (name, c) in zip(CURVES, against.items(), strict=False)
        ]
        chance = next((c.by_chance for c in against.values()), np.nan)
        curves.append(Line(y=float(chance), label="by chance", colour="alarm", style="dashed"))
        panels.append(Panel(x, Axis("coherence of the error", limits=(0.0, 1.02)), curves))
    if not panels:
        return None
    return Chart(
        "spectra",
        panels,
        f"Grey band: 95 % interval of the measured density. Coherence: error of {first.name}; "
        "dashed: reached by chance at one frequency in twenty. In closed loop a command follows "
        "the sensor's noise, and so coherence where the error is noise is the controller's doing.",
        width=_WIDTH / 2,
        height=2.5,
    )


def _coherences(
    validation: ModelValidation, channel: str, of_error: Any, length: int
) -> dict[str, Any]:
    """Of the error with each input that moves."""
    inputs = join_parts(
        [
            d.commands[run.first :]
            for d, run in zip(validation.datasets, validation.runs, strict=True)
            if channel in names(d.outputs)
        ],
        gap_samples(validation.options, validation.sample_time),
    )
    return {
        name: metrics.coherence(
            of_error, metrics.segments_of(inputs[:, i], validation.sample_time, length)
        )
        for i, name in enumerate(names(validation.datasets[0].inputs))
        if np.ptp(inputs[~np.isnan(inputs[:, i]), i]) > 0
    }


def signal_chart(signals: Sequence[metrics.Characteristics], sample_time: float) -> Chart:
    """Amplitude distribution and autocorrelation of every signal, a column a signal."""
    above, below = [], []
    for i, signal in enumerate(signals):
        share = signal.counts / max(1.0, float(np.sum(signal.counts)))
        x, y = _stairs(signal.edges, share)
        marks: list[Mark] = [Band(x, np.zeros(len(x)), y, "", "blue", 0.6)]
        centre = (signal.edges[1:] + signal.edges[:-1]) / 2
        if signal.sd > 0:
            normal = np.exp(-0.5 * ((centre - signal.mean) / signal.sd) ** 2)
            scale = np.diff(signal.edges) / (signal.sd * np.sqrt(2 * np.pi))
            marks.append(Curve(centre, normal * scale, "", "grey", "dashed", 0.9))
        of = "command " if signal.name.startswith("u_") else ""
        title = wording.with_unit(f"{of}{wording.signal(signal.name)}", signal.unit)
        above.append(Panel(Axis(""), Axis("" if i else "share"), marks, title))
        lags = np.arange(len(signal.autocorrelation)) * sample_time
        marks = [Curve(lags, signal.autocorrelation, width=1.0), Line(y=0.0)]
        label = "" if i else "autocorrelation"
        below.append(Panel(Axis("lag", "s"), Axis(label, limits=(-1.05, 1.05)), marks))
    return Chart(
        "signals",
        [*above, *below],
        "Amplitude distribution (dashed: a normal one of the same mean and deviation) and "
        "autocorrelation.",
        columns=len(signals),
        width=max(1.8, 4.0 / len(signals)),
        height=1.65,
    )
