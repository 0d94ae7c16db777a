"""Cases made to move: rigs of a set many at once, and what their sensors say as CSV."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields, replace
from multiprocessing import get_context

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
from experiments.gap.blind.nominal import nominal
from experiments.gap.blind.rig import PITCH_STOP, YAW_STOP, Driver, Nuisances, Rigs
from experiments.gap.blind.truths import TRUTHS

FloatArray = npt.NDArray[np.float64]

COLUMNS = ("u_v[V]", "u_h[V]", "alpha_v[rad]", "alpha_h[rad]", "omega_v[rad/s]", "omega_h[rad/s]")
_FORMAT = ("%.3f", "%.5f", "%.5f", "%.6f", "%.6f", "%.4f", "%.4f")
#: A rig that comes so near a stop (rad) is driven again, with so much less.
_NEAR_STOP, _LESS, _TRIES = 0.02, 0.6, 4
_SETTLING = 10.0  # s
#: s. Recordings that end between two of these are made together, as long as the longest of them.
_TOGETHER = (45.0, 130.0, 200.0, np.inf)
_OTHER = 7919  # between the seeds of one rig's commands


@dataclass(frozen=True, kw_only=True)
class Timing:
    """How long and how often."""

    duration: float | None = None  #: s; None: each case its own
    sample_time: float = 0.02  #: s

    def of(self, case: Case) -> float:
        """How long a case is recorded, s."""
        return case.duration if self.duration is None else self.duration


@dataclass(frozen=True)
class Recording:
    """What a rig did."""

    time: FloatArray  #: (k,) array; s
    commands: FloatArray  #: (k, 2) array; V
    measured: FloatArray  #: (k, 4) array; rad, rad/s


def record(
    cases: Sequence[Case],
    timing: Timing,
    seed: int,
    *,
    fresh: bool = False,
    jobs: int = 1,
    tries: int = _TRIES,
) -> tuple[list[Case], list[Recording]]:
    """Run all cases.

    Parameters
    ----------
    cases : sequence of Case
    timing : Timing
    seed : int
        Of noise, jitter and drift.
    fresh : bool
        Other commands of the same kind, for a second recording of the same rigs; what begins
        within the first is there all the time.
    jobs : int
        Processes.
    tries : int
        How often a rig that comes near a stop is driven, each time with less.

    Returns
    -------
    cases : list of Case
        As driven: with the amplitudes that kept the rigs off their stops.
    recordings : list of Recording
    """
    timed = [_timed(case, timing.of(case), fresh) for case in cases]
    of_length = np.searchsorted(_TOGETHER, [case.duration for case in timed])
    groups = [np.flatnonzero(of_length == length) for length in np.unique(of_length)]
    tasks = [
        (
            [timed[i] for i in group],
            timing.sample_time,
            [seed, int(of_length[group[0]])],
            fresh,
            tries,
        )
        for group in groups
    ]
    if jobs == 1 or len(tasks) == 1:
        group_results = [_run_off_stops(*task) for task in tasks]
    else:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            group_results = list(pool.map(_run_off_stops, *zip(*tasks, strict=True)))
    ordered_recordings: list[Recording | None] = [None] * len(timed)
    for group, (driven_cases, recordings) in zip(groups, group_results, strict=True):
        for i, case, recording in zip(group, driven_cases, recordings, strict=True):
            timed[i], ordered_recordings[i] = case, recording
    if fresh:  # the key keeps the case of the first recording
        timed = list(cases)
    return timed, [recording for recording in ordered_recordings if recording is not None]


def references_of(case: Case) -> list[Case]:
    """The same rig in its known state, driven otherwise, once for each of its references."""
    return [
        replace(
            case,
            effects={},
            moved={},
            onset={},
            references=0,
            excitation=(case.excitation + _OTHER * number) % 2**31,
        )
        for number in range(1, case.references + 1)
    ]


def _timed(case: Case, duration: float, fresh: bool) -> Case:
    """A case that is recorded as long; what begins within it does so at the same share of it."""
    share = duration / case.duration
    onset = {} if fresh else {e: round(t * share, 4) for e, t in case.onset.items()}
    return replace(case, duration=duration, onset=onset)


def _run_off_stops(
    cases: list[Case], sample_time: float, seed: list[int], fresh: bool, tries: int
) -> tuple[list[Case], list[Recording]]:
    scaled_cases = list(cases)
    recordings = _run(scaled_cases, sample_time, [*seed, 0, fresh], fresh)
    for turn in range(1, tries):
        hit = [i for i, recording in enumerate(recordings) if at_stops(recording)]
        if not hit:
            break
        for i in hit:
            scaled_cases[i] = replace(
                scaled_cases[i], amplitude=round(_LESS * scaled_cases[i].amplitude, 4)
            )
        again = _run([scaled_cases[i] for i in hit], sample_time, [*seed, turn, fresh], fresh)
        for i, recording in zip(hit, again, strict=True):
            recordings[i] = recording
    return scaled_cases, recordings


def _run(cases: list[Case], sample_time: float, seed: list[int], fresh: bool) -> list[Recording]:
    rigs = rigs_of(cases, int(np.random.SeedSequence(seed).generate_state(1)[0]))
    longest = max(case.duration for case in cases)
    driver = _driver(cases, longest, sample_time, fresh)
    run = rigs.run(driver, longest, sample_time, _SETTLING)
    recordings = []
    for i, case in enumerate(cases):
        k = round(case.duration / sample_time)
        recordings.append(Recording(run.time[:k], run.commands[i, :k], run.measured[i, :k]))
    return recordings


def rigs_of(cases: Sequence[Case], seed: int) -> Rigs:
    """The rigs of cases; ``seed``: of noise, jitter and drift."""
    return Rigs(_constants(cases), _sizes(cases), _nuisances(cases), seed, _onsets(cases))


def _nuisances(cases: Sequence[Case]) -> Nuisances:
    """Those of all rigs; what is the same in all stays a number."""
    values_by_name: dict[str, FloatArray] = {}
    for entry in fields(Nuisances):
        values = [case.nuisances.get(entry.name, entry.default) for case in cases]
        if any(value != entry.default for value in values):
            values_by_name[entry.name] = np.array(values, dtype=float)
    return Nuisances(**values_by_name)


def _onsets(cases: Sequence[Case]) -> dict[str, FloatArray]:
    """By the sizes that make an effect: its others are forms, which wait."""
    onsets_by_size: dict[str, FloatArray] = {}
    for i, case in enumerate(cases):
        for effect, time in case.onset.items():
            for size in (*TRUTHS[effect].grows, *TRUTHS[effect].acts):
                onsets_by_size.setdefault(f"{effect}.{size}", np.zeros(len(cases)))[i] = time
    return onsets_by_size


def _constants(cases: Sequence[Case]) -> dict[str, FloatArray]:
    rigs = [case.parameter_values() for case in cases]
    return {name: np.array([values[name] for values in rigs]) for name in nominal()}


def _sizes(cases: Sequence[Case]) -> dict[str, FloatArray]:
    sizes_by_name: dict[str, FloatArray] = {}
    for i, case in enumerate(cases):
        for effect, sizes in (*case.standing.items(), *case.effects.items()):
            for name, value in sizes.items():
                sizes_by_name.setdefault(f"{effect}.{name}", np.zeros(len(cases)))[i] = value
    return sizes_by_name


def _driver(cases: Sequence[Case], longest: float, sample_time: float, fresh: bool) -> Driver:
    """All drivers; a table that ends early stays at its last command."""
    tables: list[FloatArray] = []
    table_of, references, following = [], [], []
    for i, case in enumerate(cases):
        samples = round(case.duration / sample_time)
        last = ((0, round(longest / sample_time) - samples), (0, 0))
        seed = [case.excitation + 2**31 * fresh]
        if case.drive == "closed_loop":
            following.append(i)
            reference = case.amplitude * square_references(seed, samples, sample_time)[0]
            references.append(np.pad(reference, last, mode="edge"))
            continue
        table_of.append(i)
        centre, amplitude = case.centre, case.amplitude
        if case.drive == "poor":
            table = poor_excitation(seed, samples, sample_time, centre=centre)[0]
        else:
            table = rich_excitation(seed, samples, sample_time, centre=centre, amplitude=amplitude)[
                0
            ]
        tables.append(np.pad(table, last, mode="edge"))
    parts: list[tuple[npt.NDArray[np.int64], Driver]] = []
    if tables:
        parts.append((np.array(table_of), OpenLoop(np.array(tables))))
    if following:
        parts.append((np.array(following), CascadedPid(np.array(references), sample_time)))
    return MixedDrivers(parts)


def at_stops(recording: Recording) -> bool:
    """Whether a rig came near a stop: there is none in the model, and none in the key."""
    reach = np.abs(recording.measured[:, :2]).max(axis=0)
    return bool((reach > np.array([PITCH_STOP - _NEAR_STOP, YAW_STOP - _NEAR_STOP])).any())


def csv_of(case: Case, recording: Recording) -> str:
    """A recording as any lab would write it."""
    angles = case.channels == "angles"
    columns = COLUMNS[:4] if angles else COLUMNS
    loop = "closed" if case.drive == "closed_loop" else "open"
    lines = ["# rig: bench rig", f"# loop: {loop}", ",".join(("t[s]", *columns))]
    rows = np.column_stack(
        [recording.time, recording.commands, recording.measured[:, : 2 if angles else 4]]
    )
    form = ",".join(_FORMAT[: rows.shape[1]])
    lines += [form % tuple(row) for row in rows]
    return "\n".join(lines) + "\n"
