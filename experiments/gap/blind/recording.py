"""Cases made to move: all rigs of a set at once, and what their sensors say as CSV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.cases import Case
from experiments.gap.blind.drivers import (
    CascadedPid,
    MixedDrivers,
    OpenLoop,
    poor_excitation,
    rich_excitation,
    square_references,
)
from experiments.gap.blind.nominal import nominal, relative_sds
from experiments.gap.blind.rig import PITCH_STOP, YAW_STOP, Driver, Nuisances, RigRecordings, Rigs

FloatArray = npt.NDArray[np.float64]

COLUMNS = ("u_v[V]", "u_h[V]", "alpha_v[rad]", "alpha_h[rad]", "omega_v[rad/s]", "omega_h[rad/s]")
_FORMAT = ("%.3f", "%.5f", "%.5f", "%.6f", "%.6f", "%.4f", "%.4f")
#: A rig that comes so near a stop (rad) is driven again, with so much less.
_NEAR_STOP, _LESS, _TRIES = 0.02, 0.6, 4
_SETTLING = 10.0  # s


@dataclass(frozen=True, kw_only=True)
class Timing:
    """How long and how often."""

    duration: float = 120.0  #: s
    sample_time: float = 0.02  #: s


def record(
    cases: Sequence[Case], timing: Timing, seed: int, *, fresh: bool = False
) -> tuple[list[Case], RigRecordings]:
    """Run all cases.

    Parameters
    ----------
    cases : sequence of Case
    timing : Timing
    seed : int
        Of noise, jitter and drift.
    fresh : bool
        Other commands of the same kind, for a second recording of the same rigs.

    Returns
    -------
    cases : list of Case
        With the amplitudes that kept the rigs off their stops.
    recorded : RigRecordings
        All six columns of every case.
    """
    tried = list(cases)
    run = _run(tried, timing, [seed, 0], fresh)
    for turn in range(1, _TRIES):
        hit = np.flatnonzero(_at_stops(run))
        if not len(hit):
            break
        for i in hit:
            tried[i] = replace(tried[i], amplitude=round(_LESS * tried[i].amplitude, 4))
        again = _run([tried[i] for i in hit], timing, [seed, turn], fresh)
        run.commands[hit], run.measured[hit] = again.commands, again.measured
    return tried, run


def _run(cases: Sequence[Case], timing: Timing, seed: list[int], fresh: bool) -> RigRecordings:
    rigs = Rigs(
        _constants(cases),
        _sizes(cases),
        Nuisances(jitter=np.array([case.jitter for case in cases])),
        int(np.random.SeedSequence([*seed, fresh]).generate_state(1)[0]),
    )
    driver = _driver(cases, timing, fresh)
    return rigs.run(driver, timing.duration, timing.sample_time, _SETTLING)


def _constants(cases: Sequence[Case]) -> dict[str, FloatArray]:
    sds = relative_sds()
    return {
        name: np.array(
            [value * (1 + sds.get(name, 0.0) * case.parameters.get(name, 0.0)) for case in cases]
        )
        for name, value in nominal().items()
    }


def _sizes(cases: Sequence[Case]) -> dict[str, FloatArray]:
    found: dict[str, FloatArray] = {}
    for i, case in enumerate(cases):
        for effect, sizes in case.effects.items():
            for name, value in sizes.items():
                found.setdefault(f"{effect}.{name}", np.zeros(len(cases)))[i] = value
    return found


def _driver(cases: Sequence[Case], timing: Timing, fresh: bool) -> Driver:
    samples, step = round(timing.duration / timing.sample_time), timing.sample_time
    tables: list[FloatArray] = []
    table_of, references, following = [], [], []
    for i, case in enumerate(cases):
        seed = [case.excitation + 2**31 * fresh]
        if case.drive == "closed_loop":
            following.append(i)
            middle = case.amplitude * square_references(seed, samples, step)[0]
            references.append(middle)
            continue
        table_of.append(i)
        tables.append(
            poor_excitation(seed, samples, step, centre=case.centre)[0]
            if case.drive == "poor"
            else rich_excitation(seed, samples, step, centre=case.centre, amplitude=case.amplitude)[
                0
            ]
        )
    parts: list[tuple[npt.NDArray[np.int64], Driver]] = []
    if tables:
        parts.append((np.array(table_of), OpenLoop(np.array(tables))))
    if following:
        parts.append((np.array(following), CascadedPid(np.array(references), step)))
    return MixedDrivers(parts)


def _at_stops(run: RigRecordings) -> npt.NDArray[np.bool_]:
    """Which rigs came near a stop: there is none in the model, and none in the key."""
    reach = np.abs(run.measured[..., :2]).max(axis=1)
    near: npt.NDArray[np.bool_] = (
        reach > np.array([PITCH_STOP - _NEAR_STOP, YAW_STOP - _NEAR_STOP])
    ).any(axis=1)
    return near


def csv_of(case: Case, time: FloatArray, commands: FloatArray, measured: FloatArray) -> str:
    """A recording as any lab would write it.

    Parameters
    ----------
    time : (k,) array
    commands : (k, 2) array
    measured : (k, 4) array
    """
    angles = case.channels == "angles"
    columns = COLUMNS[:4] if angles else COLUMNS
    loop = "closed" if case.drive == "closed_loop" else "open"
    lines = ["# rig: bench rig", f"# loop: {loop}", ",".join(("t[s]", *columns))]
    rows = np.column_stack([time, commands, measured[:, : 2 if angles else 4]])
    form = ",".join(_FORMAT[: rows.shape[1]])
    lines += [form % tuple(row) for row in rows]
    return "\n".join(lines) + "\n"
