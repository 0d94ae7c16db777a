"""What a recording is like, before anything is done with it: figures, and sentences for people."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from trms_cli.recordings.delays import Delay, estimate_delays
from trms_cli.recordings.grid import runs
from trms_cli.recordings.loop import Loop, find_loop
from trms_cli.recordings.outliers import describe_outliers, find_outliers
from trms_cli.recordings.recording import Recording, quantum

#: A channel with fewer levels is a switched signal: being at its largest is no saturation.
_LEAST_LEVELS = 12
#: A signal that stays as it was at more samples than this is held between levels.
_HELD_SHARE = 0.5
#: A command at its extreme value for more of the time than this is worth a sentence.
_SATURATED_SHARE = 0.02
#: s for which an angle must keep still to be at rest.
_REST_TIME = 0.5
#: Share of the largest size beyond which a change of sign counts.
_CROSSING_SHARE = 0.05
_SMOOTHING_TIME = 0.2


@dataclass(frozen=True)
class ChannelFindings:
    """Figures of a channel."""

    minimum: float | None  #: In the channel's unit
    maximum: float | None  #: None for a channel without a value
    quantum: float | None  #: Distance between levels, where they lie on a grid
    missing: int  #: Samples without a value among the rows
    outliers: int  #: Samples that neither neighbour leads to
    constant: bool  #: Whether it never changes
    #: Inputs: share of the time at the largest or smallest value taken, when many are taken
    extreme_share: float | None = None
    #: Angles: share of the time at which it keeps still for half a second around
    rest_share: float | None = None
    #: Angles: how often the rate changes its sign. Rotor speeds: how often the rotor reverses.
    turns: int | None = None


@dataclass(frozen=True)
class Findings:
    """What was found in a recording."""

    channels: dict[str, ChannelFindings]
    delays: list[Delay]
    loop: Loop
    sentences: list[str]  #: For people: faults first, then what is worth knowing

    def as_data(self) -> dict[str, Any]:
        """For a JSON document; without the sentences."""
        return {
            "channels": {name: asdict(channel) for name, channel in self.channels.items()},
            "delays": [
                {
                    "cause": d.cause,
                    "effect": d.effect,
                    "delay_s": d.seconds,
                    "deviation_s": d.deviation,
                    "explained": d.explained,
                    "clear": d.clear,
                }
                for d in self.delays
            ],
            "loop": {
                "state": self.loop.state,
                "declared": self.loop.declared,
                "answered": self.loop.answered,
            },
        }


def look_at(recording: Recording, jitter: float = 0.2) -> Findings:
    """Look at a recording; nothing is changed.

    Parameters
    ----------
    recording : Recording
        As read, with its gaps.
    jitter : float
        How uneven the sampling may be for delays and the loop to be estimated, as a share of a
        sample.
    """
    masks = find_outliers(recording)
    channels = {name: _channel(recording, name, masks) for name in recording.channels}
    delays = estimate_delays(recording, jitter)
    loop = find_loop(recording, jitter)
    sentences = [*remarks_on(recording, masks)]
    sentences += [delay.sentence() for delay in delays if delay.clear]
    sentences.append(loop.sentence())
    return Findings(channels, delays, loop, sentences)


def remarks_on(recording: Recording, masks: dict[str, np.ndarray] | None = None) -> list[str]:
    """Sentences on what may be wrong with the channels: cheap enough for every reading."""
    if masks is None:
        masks = find_outliers(recording)
    sentences = [
        f"{sentence}; --outliers mark, or data.outliers=mark, makes them missing"
        for sentence in describe_outliers(recording, masks)
    ]
    for name, values in recording.channels.items():
        there = values[np.isfinite(values)]
        if not len(there):
            sentences.append(f"{name}: not a single value")
        elif float(np.ptp(there)) == 0 and name not in recording.names("disturbance"):
            sentences.append(f"{name} is constant at {there[0]:.4g} {recording.units[name]}")
    for name in recording.names("input"):
        share = _extreme_share(recording.channels[name])
        if share is not None and share > _SATURATED_SHARE:
            largest = float(np.nanmax(np.abs(recording.channels[name])))
            unit = recording.units[name]
            size = f"{largest:.4g}" + (f" {unit}" if unit != "1" else "")
            sentences.append(f"{name} is at its largest, {size}, for {share:.0%} of the time")
    return sentences


def _channel(recording: Recording, name: str, masks: dict[str, np.ndarray]) -> ChannelFindings:
    values = recording.channels[name]
    there = values[np.isfinite(values)]
    mask = masks.get(name)
    inputs, outputs = recording.names("input"), recording.names("output")
    angle = name in outputs and recording.units[name] == "rad"
    rest, turns = None, None
    if name in outputs and len(there) > 10:
        rest, turns = _motion(there, recording.sample_time, angle)
    return ChannelFindings(
        float(there.min()) if len(there) else None,
        float(there.max()) if len(there) else None,
        quantum(values),
        recording.missing.get(name, 0),
        int(mask.sum()) if mask is not None else 0,
        len(there) > 0 and float(np.ptp(there)) == 0,
        _extreme_share(values) if name in inputs else None,
        rest,
        turns,
    )


def _extreme_share(values: np.ndarray) -> float | None:
    """Share of the time at the extreme values, by runs of at least two.

    None where that tells nothing: for few levels, and for a signal that is held at every level.
    """
    there = values[np.isfinite(values)]
    if len(np.unique(there)) < _LEAST_LEVELS:
        return None
    near = 1e-6 * float(np.ptp(there))
    at_limit = (there >= there.max() - near) | (there <= there.min() + near)
    elsewhere = ~at_limit[1:]
    if np.any(elsewhere) and np.mean(np.diff(there)[elsewhere] == 0) > _HELD_SHARE:
        return None
    return sum(count for _, count in runs(at_limit) if count > 1) / len(there)


def _motion(values: np.ndarray, step: float, angle: bool) -> tuple[float | None, int]:
    """Share of rest (angles) and number of reversals, of the samples that there are."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

    width = max(3, round(_SMOOTHING_TIME / step))
    smooth = uniform_filter1d(values, width)
    if not angle:
        return None, _sign_changes(smooth)
    third = np.diff(values, 3)
    noise = 1.4826 * float(np.median(np.abs(third))) / 20**0.5
    still = max(2.01 * (quantum(values) or 0.0), 6 * noise)
    around = max(3, round(_REST_TIME / step))
    spread = maximum_filter1d(values, around) - minimum_filter1d(values, around)
    return float(np.mean(spread <= still)), _sign_changes(np.diff(smooth))


def _sign_changes(values: np.ndarray) -> int:
    """Changes of sign between sizes above a share of the largest."""
    size = _CROSSING_SHARE * float(np.abs(values).max(initial=0.0))
    signs = np.sign(values[np.abs(values) > size])
    return int(np.count_nonzero(np.diff(signs)))
