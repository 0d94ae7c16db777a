"""What an excitation has to tell: inputs, what the rig will do, spectra over the noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trms_cli.core import wording
from trms_cli.core.arrays import FloatArray
from trms_cli.core.chart import CURVES, Axis, Band, Chart, Curve, Line, Mark, Panel
from trms_cli.core.findings import Column, Findings, Measure, NextCommand, Section, table
from trms_cli.identification.excitation.design import ExcitationDesign
from trms_cli.models.model import names

#: Bands an octave in which spectra are averaged.
_BANDS_AN_OCTAVE = 3
#: Signal over noise (power) from which a frequency counts as seen: 10 dB.
_SEEN = 10.0


@dataclass(frozen=True)
class Spectra:
    """One-sided power spectral densities, averaged in bands of a third of an octave."""

    frequencies: FloatArray  #: (m,) array; middles of the bands that hold one of the record, Hz
    inputs: FloatArray  #: (m, n_u) array; in the input's unit squared over Hz; about the mean
    outputs: FloatArray  #: (m, n_y) array; of the simulated rig without noise
    noise: FloatArray  #: (n_y,) array; of the declared noise, which is white: 2 σ² T_s
    response: FloatArray  #: (m, n_y, n_u) array; of the linearised model, magnitude

    @property
    def ratio(self) -> FloatArray:
        """Signal over noise (power), (m, n_y)."""
        return self.outputs / self.noise


def spectra_of(design: ExcitationDesign, noise_sd: Mapping[str, float]) -> Spectra:
    """Spectra of a design.

    ``noise_sd``: standard deviation of each output's white noise, a quantum's share included.
    """
    from scipy.signal import periodogram

    step, model = design.plan.sample_time, design.model

    def densities(values: FloatArray) -> tuple[FloatArray, FloatArray]:
        # Multisines have whole periods in the record, and need no window; the others leak little.
        frequency, density = periodogram(values, 1 / step, window="boxcar", axis=0)
        return frequency[1:], density[1:]

    frequency, of_inputs = densities(design.commands[design.first :])
    _, of_outputs = densities(design.outputs[design.first :])
    ratio = 2 ** (1 / _BANDS_AN_OCTAVE)
    lowest, highest = design.plan.lowest, design.plan.highest
    count = int(np.ceil(np.log(highest / lowest) / np.log(ratio))) + 6
    edges = lowest * ratio ** (np.arange(count + 1) - 3.5)
    band = np.digitize(frequency, edges) - 1
    used = [i for i in range(count) if np.any(band == i)]
    middles = np.sqrt(edges[:-1] * edges[1:])[used]

    def averaged(density: FloatArray) -> FloatArray:
        return np.array([density[band == i].mean(axis=0) for i in used])

    noise = np.array([max(noise_sd.get(name, 0.0), 1e-9) for name in names(model.outputs)])
    return Spectra(
        middles,
        averaged(of_inputs),
        averaged(of_outputs),
        2 * noise**2 * step,
        np.abs(design.system.response(middles)),
    )


def summary(design: ExcitationDesign, spectra: Spectra) -> dict[str, Any]:
    """The design as plain data, SI: the body of ``trms.excitation/1``."""
    model, plan = design.model, design.plan
    inside = (spectra.frequencies >= plan.lowest * 0.99) & (
        spectra.frequencies <= plan.highest * 1.01
    )
    values = design.shape.values
    predicted = {}
    for i, signal in enumerate(model.outputs):
        ratio = spectra.ratio[inside, i]
        visible_frequencies = spectra.frequencies[inside][ratio > _SEEN] * 2 ** (
            0.5 / _BANDS_AN_OCTAVE
        )
        predicted[signal.name] = {
            "unit": signal.unit,
            "range": list(design.ranges[signal.name]),
            "range_of_drawn_rigs": list(design.drawn_ranges.get(signal.name, ())) or None,
            "seen_up_to_hz": min(plan.highest, float(visible_frequencies.max()))
            if len(visible_frequencies)
            else None,
            "signal_to_noise_db": (10 * np.log10(np.maximum(ratio, 1e-30))).tolist(),
        }
    return {
        "model": model.name,
        "duration_s": plan.duration,
        "lead_in_s": design.first * plan.sample_time,
        "sample_time_s": plan.sample_time,
        "band_hz": [plan.lowest, plan.highest],
        "poles_hz": [pole / (2 * np.pi) for pole in design.poles],
        "inputs": {
            signal.name: {
                "unit": signal.unit,
                "centre": float(design.centre[i]),
                "amplitude": float(design.amplitude[i]),
                "crest_factor": float(design.crest_factor[i]),
                "limit": float(model.input_limits[signal.name]),
            }
            for i, signal in enumerate(model.inputs)
        },
        "correlation_of_inputs": float(np.asarray(np.corrcoef(values.T))[0, 1])
        if values.shape[1] > 1
        else None,
        "bounds_rad": design.bounds,
        "predicted": predicted,
        "frequencies_hz": spectra.frequencies[inside].tolist(),
        "drawn_rigs": design.rig_count,
        "drawn_rigs_beyond_stops": design.lost_rig_count,
        "signals": design.shape.about,
    }


def findings(
    document: Mapping[str, Any],
    designed: ExcitationDesign | None = None,
    spectra: Spectra | None = None,
    then: Sequence[NextCommand] = (),
) -> Findings:
    """What is worth telling of an excitation: of ``trms.excitation/1``.

    ``designed``, ``spectra``: what the chart is drawn of. ``then``: what to type next.
    """
    low, high = document["band_hz"]
    slow, fast = document["poles_hz"]
    loss_count, rig_count = document["drawn_rigs_beyond_stops"], document["drawn_rigs"]
    warnings = []
    if loss_count:
        warnings.append(
            f"{loss_count} of {wording.count(rig_count, 'rig')} drawn from the priors reach a "
            "stop: watch the first run, or lower share"
        )
    chart = None if designed is None or spectra is None else excitation_chart(designed, spectra)
    sections = [Section("Inputs", (), [_inputs(document)]), _predicted(document)]
    sections += [Section("Picture", (), [chart])] if chart is not None else []
    return Findings(
        title=f"Excitation: {document['kind']} for {document['model']}",
        lead=[
            f"{document['duration_s']:g} s after {document['lead_in_s']:g} s of lead-in, from "
            f"{wording.interval(low, high, 'Hz')} (the model's poles: "
            f"{wording.interval(slow, fast, 'Hz')})."
        ],
        sections=sections,
        warnings=warnings,
        measures=_measures(document),
        next=then,
    )


def _measures(document: Mapping[str, Any]) -> list[Measure]:
    """How long it is, where its outputs go, and up to where all of them stand over the noise."""
    predicted = document["predicted"].items()
    ranges = [
        Measure(wording.signal(name), _range(one["range"]), one["unit"], "", "range simulated")
        for name, one in predicted
        if name in document["bounds_rad"]
    ]
    ends = [one["seen_up_to_hz"] or 0.0 for _, one in predicted]
    drawn, lost = document["drawn_rigs"], document["drawn_rigs_beyond_stops"]
    return [
        Measure("excitation", document["duration_s"], "s"),
        *ranges,
        Measure("over the noise", f"up to {wording.number(min(ends))}", "Hz", "", "all outputs"),
        Measure("reach a stop", f"{lost} of {drawn}", "", "bad" if lost else "good", "drawn rigs"),
    ]


def _inputs(document: Mapping[str, Any]) -> Any:
    def centre(item: Any) -> float:
        """What rounding of the steady state leaves is no command."""
        small = abs(item[1]["centre"]) < 1e-4 * item[1]["limit"]
        return 0.0 if small else float(item[1]["centre"])

    columns = [
        Column("input", lambda item: wording.with_unit(item[0], item[1]["unit"])),
        Column("centre", centre),
        Column("amplitude", lambda item: item[1]["amplitude"]),
        Column("limit", lambda item: item[1]["limit"]),
        Column("crest factor", lambda item: item[1]["crest_factor"]),
    ]
    caption = ""
    if document["correlation_of_inputs"] is not None:
        # adding zero takes the sign from what rounds to it
        alike = round(document["correlation_of_inputs"], 3) + 0.0
        caption = f"Correlation of the two: {wording.number(alike)}."
    return table(document["inputs"].items(), columns, caption)


def _predicted(document: Mapping[str, Any]) -> Section:
    columns = [
        Column("output", lambda item: wording.with_unit(wording.signal(item[0]), item[1]["unit"])),
        Column("range", lambda item: _range(item[1]["range"])),
        Column("of drawn rigs", lambda item: _range(item[1]["range_of_drawn_rigs"])),
        Column("over the noise up to [Hz]", lambda item: item[1]["seen_up_to_hz"]),
    ]
    text = "Simulated with the model; beside it the range of rigs drawn from the priors."
    return Section("What the rig will do", [text], [table(document["predicted"].items(), columns)])


def _range(ends: Sequence[float] | None) -> str:
    return wording.interval(ends[0], ends[1]) if ends else wording.MISSING


def excitation_chart(designed: ExcitationDesign, spectra: Spectra) -> Chart:
    """Commands, angles, spectra of both over the noise, responses, and where the rig goes."""
    of = _Panels(designed, spectra)
    outputs, units = of.outputs, of.units
    # of a rotor alone, which has no bound, the outputs in the unit of the first
    alike = [name for name in outputs if units[name] == units[outputs[0]]]
    bounded = [name for name in outputs if name in designed.bounds] or alike
    speeds = [name for name in outputs if name not in bounded]
    values = {name: designed.outputs[:, i] for i, name in enumerate(outputs)}
    panels = [
        of.over_time({n: designed.commands[:, i] for i, n in enumerate(of.inputs)}, True),
        of.over_time({name: values[name] for name in bounded}, False),
        of.input_spectra(),
        of.responses(bounded),
        *(of.output_spectra(group) for group in (bounded, speeds) if group),
    ]
    for i, (angle, speed) in enumerate((("alpha_v", "omega_v"), ("alpha_h", "omega_h"))):
        if angle in values and speed in values:
            x, y = values[speed][designed.first :], values[angle][designed.first :]
            bound = designed.bounds[angle]
            limits = [Line(y=s * bound, colour="alarm", style="dashed") for s in (-1, 1)]
            marks: list[Mark] = [Curve(x, y, "", CURVES[i], width=0.5), *limits]
            x_axis = Axis(wording.signal(speed), "rad/s")
            panels.append(Panel(x_axis, Axis(wording.signal(angle), "rad"), marks))
    rates = [name for name in outputs if name in designed.bounds]
    if rates:
        panels.append(of.rates({name: values[name] for name in rates}))
    return Chart(
        "excitation",
        panels,
        "Simulated with the model. The band is shaded; dashed in grey: its slowest and fastest "
        "pole; dotted: the noise; dashed in red: the bounds.",
        width=5.5,
        height=2.3,
    )


class _Panels:
    """The panels of an excitation's chart."""

    def __init__(self, designed: ExcitationDesign, spectra: Spectra) -> None:
        self.designed, self.spectra, model = designed, spectra, designed.model
        self.inputs, self.outputs = names(model.inputs), names(model.outputs)
        self.units = {signal.name: signal.unit for signal in (*model.inputs, *model.outputs)}

    def over_time(self, signals: Mapping[str, Any], commands: bool) -> Panel:
        designed = self.designed
        marks: list[Mark] = []
        for colour, (name, values) in zip(CURVES, signals.items(), strict=False):
            label = f"{wording.signal(name)} {name}" if commands else wording.signal(name)
            marks.append(Curve(designed.time, values, label, colour, width=0.8, is_step=commands))
        if not commands:
            for bound in {
                round(designed.bounds[name], 6) for name in signals if name in designed.bounds
            }:
                marks += [Line(y=side * bound, colour="alarm", style="dashed") for side in (-1, 1)]
        if 0 < designed.first < len(designed.time):
            marks.append(Line(x=float(designed.time[designed.first]), label="", colour="ink"))
        what = "command" if commands else "angle" if designed.bounds else "speed"
        x = Axis("time", "s", (float(designed.time[0]), float(designed.time[-1])))
        return Panel(x, Axis(what, wording.unit(self.units[next(iter(signals))])), marks)

    def _spectrum(self, label: str, marks: Sequence[Mark], values: Sequence[Any]) -> Panel:
        """On logarithmic axes, with the band shaded and the poles dashed."""
        designed, spectra = self.designed, self.spectra
        poles = [Line(x=pole / (2 * np.pi), style="dashed") for pole in designed.poles]
        densities = np.concatenate([np.ravel(one) for one in values])
        densities = densities[np.isfinite(densities) & (densities > 0)]
        low, high = (0.5 * densities.min(), 2 * densities.max()) if densities.size else (0.1, 1.0)
        ends = [designed.plan.lowest, designed.plan.highest]
        band = Band(ends, [low, low], [high, high], "", "grey", 0.15)
        f = spectra.frequencies
        x = Axis("frequency", "Hz", (0.9 * float(f[0]), 1.1 * float(f[-1])), log=True)
        return Panel(x, Axis(label, limits=(low, high), log=True), [band, *poles, *marks])

    def input_spectra(self) -> Panel:
        spectra, inputs = self.spectra, self.inputs
        marks, densities = [], []
        for i, (colour, name) in enumerate(zip(CURVES, inputs, strict=False)):
            density = spectra.inputs[:, i]
            # below the resolution of a multisine's lines there is nothing to be shown
            densities.append(np.where(density > 1e-6 * density.max(), density, np.nan))
            marks.append(Curve(spectra.frequencies, densities[-1], name, colour, is_step=True))
        unit = self.units[inputs[0]]
        label = f"input [{unit}²/Hz]" if unit != "1" else "input [1/Hz]"
        return self._spectrum(label, marks, densities)

    def responses(self, output_names: Sequence[str]) -> Panel:
        spectra, inputs = self.spectra, self.inputs
        marks, values = [], []
        for colour, output in zip(CURVES, output_names, strict=False):
            for j, name in enumerate(inputs[:2]):
                response = spectra.response[:, self.outputs.index(output), j]
                if np.any(response > 1e-9):
                    label = f"{wording.signal(output)} / {name}"
                    style: Any = "dashed" if j else "solid"
                    marks.append(Curve(spectra.frequencies, response, label, colour, style, 1.2))
                    values.append(response)
        per = "/".join({self.units[name]: None for name in inputs})
        label = f"response [{self.units[output_names[0]]}/{per}]"
        return self._spectrum(label, marks, values)

    def output_spectra(self, output_names: Sequence[str]) -> Panel:
        spectra = self.spectra
        marks: list[Mark] = []
        values = []
        for colour, name in zip(CURVES, output_names, strict=False):
            i = self.outputs.index(name)
            noise = float(spectra.noise[i])
            density = spectra.outputs[:, i]
            label = wording.signal(name)
            marks.append(Curve(spectra.frequencies, density, label, colour, is_step=True))
            marks.append(Line(y=noise, colour=colour))
            values += [density, [noise]]
        return self._spectrum(f"output [({self.units[output_names[0]]})²/Hz]", marks, values)

    def rates(self, angles: Mapping[str, Any]) -> Panel:
        designed = self.designed
        marks: list[Mark] = []
        for colour, (name, values) in zip(CURVES, angles.items(), strict=False):
            rate = np.diff(values[designed.first :]) / designed.plan.sample_time
            share, edges = np.histogram(rate, bins=60, density=True)
            x, y = np.repeat(edges, 2)[1:-1], np.repeat(share, 2)
            marks.append(Curve(x, y, wording.signal(name), colour))
        return Panel(Axis("rate", "rad/s"), Axis("share", "s/rad"), marks)
