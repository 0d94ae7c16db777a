"""Nine pairs of signals between the commands and the angles, measured by multisines.

One command at a time carries a small multisine around an operating point at which both rotors
turn, several times with other phases; the other command stands still. On each line of the signal

    G = Σ Y U* / Σ |U|²        γ² = |Σ Y U*|² / (Σ |Y|² Σ |U|²)

over the realisations: the best linear approximation of the nonlinear model, and the share of the
output's power on that line that is a linear answer (R. Pintelon & J. Schoukens, *System
Identification: A Frequency Domain Approach*, 2nd ed. 2012, ch. 4). The simulation has no noise:
what is missing to γ² = 1 is nonlinear. From a rotor speed to an angle G is the ratio of two
responses to the same command.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiments.chapter2.simulation import FloatArray, OpenLoop
from experiments.chapter2.study import Study
from trms_cli.models.model import names
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import at_command
from trms_cli.stability.loops.frequency_response import multisine

ComplexArray = npt.NDArray[np.complex128]
#: The pairs: from, to, and the command that carries the signal.
PAIRS = (
    ("u_v", "omega_v", "u_v"),
    ("u_v", "alpha_v", "u_v"),
    ("u_v", "alpha_h", "u_v"),
    ("u_h", "omega_h", "u_h"),
    ("u_h", "alpha_h", "u_h"),
    ("u_h", "alpha_v", "u_h"),
    ("omega_v", "alpha_v", "u_v"),
    ("omega_v", "alpha_h", "u_v"),
    ("omega_h", "alpha_h", "u_h"),
)


@dataclass(frozen=True)
class Path:
    """What one pair of signals does.

    Where the slowest line is answered by its rate more than by itself (its real part is the smaller
    one) the pair *passes a band*: bandwidth counts from the peak, and there is no delay.
    """

    source: str
    target: str
    frequency: FloatArray  #: (n,) array; Hz
    response: ComplexArray  #: (n,) array; of the target's unit over the source's
    coherence: FloatArray  #: (n,) array; with the small signal
    coherence_large: FloatArray  #: (n,) array; with the large one
    static_gain: float  #: Real part on the lowest line: even in the frequency, and so nearly G(0)
    peak: float  #: Largest gain
    peak_frequency: float  #: Hz
    bandwidth: float  #: Hz, from where on the gain stays below 0.71 of the static one (or the peak)
    delay: float  #: s, group delay over the lines below half of bandwidth and peak

    @property
    def passes_band(self) -> bool:
        """Whether slow changes pass by their rate."""
        return abs(self.response[0].imag) > abs(self.response[0].real)

    @property
    def resonance(self) -> float:
        """Peak over the static gain, dB; NaN without a peak, or where a band passes."""
        if self.passes_band or self.peak < 1.02 * abs(self.static_gain):
            return float("nan")
        return float(20 * np.log10(self.peak / abs(self.static_gain)))

    def mean_coherence(self, coherence: FloatArray) -> float:
        """Over the lines up to the bandwidth and the peak."""
        return float(coherence[self.frequency <= max(self.bandwidth, self.peak_frequency)].mean())


@dataclass(frozen=True)
class _Measurement:
    frequency: FloatArray  #: Hz
    response: Mapping[str, ComplexArray]  #: By output
    coherence: Mapping[str, FloatArray]  #: By output


def study_paths(study: Study) -> list[Path]:
    """Measure all pairs."""
    small, large = (
        {command: _measure(study, command, scale) for command in ("u_v", "u_h")}
        for scale in (1.0, study.paths.larger)
    )
    return [
        _path(source, target, small[command], large[command]) for source, target, command in PAIRS
    ]


def _measure(study: Study, command: str, scale: float) -> _Measurement:
    """Responses of all outputs to one command."""
    settings, model = study.paths, Newtonian()
    inputs, outputs = names(model.inputs), names(model.outputs)
    point = at_command(model, np.array([settings.point[name] for name in inputs]))
    start = dict(zip(model.state_names, point.x.tolist(), strict=True))
    substeps = max(1, round(settings.hold / study.sample_time)) * study.substeps
    loop = OpenLoop(model, settings.hold, substeps, stops=False)
    excited, answers = [], []
    for seed in range(1, settings.realisations + 1):
        wave = multisine(settings.hold, 2 * np.pi / settings.period, settings.ratio, seed)
        u = np.tile(point.u, (settings.periods * wave.length, 1))
        one = scale * settings.rms[command] * wave.values
        u[:, inputs.index(command)] += np.tile(one, settings.periods)
        y = loop.respond(u, start).outputs
        excited.append(wave.spectrum(one[:, None])[:, 0])
        last = {name: values[-wave.length :] for name, values in y.items()}
        answers.append({name: wave.spectrum(v[:, None])[:, 0] for name, v in last.items()})
    U = np.array(excited)
    response, coherence = {}, {}
    for name in outputs:
        Y = np.array([answer[name] for answer in answers])
        cross = (Y * U.conj()).sum(axis=0)
        power_u, power_y = (np.abs(U) ** 2).sum(axis=0), (np.abs(Y) ** 2).sum(axis=0)
        response[name] = cross / power_u
        floor = np.finfo(float).tiny
        coherence[name] = np.abs(cross) ** 2 / np.maximum(power_u * power_y, floor)
    in_band = wave.omega / (2 * np.pi) <= settings.highest
    return _Measurement(
        wave.omega[in_band] / (2 * np.pi),
        {name: values[in_band] for name, values in response.items()},
        {name: values[in_band] for name, values in coherence.items()},
    )


def _path(source: str, target: str, small: _Measurement, large: _Measurement) -> Path:
    response = small.response[target]
    coherence, coherence_large = small.coherence[target], large.coherence[target]
    if source in small.response:  # from a rotor speed: a ratio, as linear as the worse of the two
        response = response / small.response[source]
        coherence = np.minimum(coherence, small.coherence[source])
        coherence_large = np.minimum(coherence_large, large.coherence[source])
    f, gain = small.frequency, np.abs(response)
    first = response[0]
    static, top = float(first.real), int(np.argmax(gain))
    by_rate = abs(first.imag) > abs(first.real)
    level = gain[top] if by_rate else abs(static)
    bandwidth = float(f[int(np.flatnonzero(gain >= level / np.sqrt(2))[-1])])
    slow = f <= max(min(bandwidth, f[top] if top else np.inf) / 2, f[3])
    phase = np.unwrap(np.angle(response[slow]))
    delay = np.nan if by_rate else -float(np.polyfit(2 * np.pi * f[slow], phase, 1)[0])
    return Path(
        source,
        target,
        f,
        response,
        coherence,
        coherence_large,
        static,
        float(gain[top]),
        float(f[top]),
        bandwidth,
        delay,
    )
