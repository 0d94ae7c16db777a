"""What an excitation excites: spectra of inputs and outputs over the noise, and a summary."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.excitation.design import ExcitationDesign
from trms_cli.models.model import names

#: Bands an octave in which spectra are averaged.
_BANDS_AN_OCTAVE = 3
#: Signal over noise (power) from which a frequency counts as seen: 10 dB.
_SEEN = 10.0


@dataclass(frozen=True)
class Spectra:
    """One-sided power spectral densities, averaged in bands of a third of an octave."""

    #: (m,) array; middles of the bands that hold a frequency of the record, Hz
    frequencies: FloatArray
    inputs: FloatArray  #: (m, n_u) array; in the input's unit squared over Hz; about the mean
    outputs: FloatArray  #: (m, n_y) array; of the simulated rig without noise
    noise: FloatArray  #: (n_y,) array; of the declared noise, which is white: 2 σ² T_s
    #: (m, n_y, n_u) array; magnitude of the linearised model's frequency response
    response: FloatArray

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
        seen = spectra.frequencies[inside][ratio > _SEEN] * 2 ** (0.5 / _BANDS_AN_OCTAVE)
        predicted[signal.name] = {
            "unit": signal.unit,
            "range": list(design.ranges[signal.name]),
            "range_of_drawn_rigs": list(design.drawn_ranges.get(signal.name, ())) or None,
            "seen_up_to_hz": min(plan.highest, float(seen.max())) if len(seen) else None,
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
        "drawn_rigs": design.drawn,
        "drawn_rigs_beyond_stops": design.lost,
        "signals": design.shape.about,
    }
