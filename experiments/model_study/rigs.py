"""The rigs of the study and their recordings: code of the blind benchmark, drawn from seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from experiments.gap.blind.drivers import (
    CascadedPid,
    MixedDrivers,
    OpenLoop,
    square_references,
)
from experiments.gap.blind.nuisances import draw_nuisances, imperfect_laws
from experiments.gap.blind.rig import Driver, Nuisances, RigRecordings, Rigs
from experiments.gap.rigs import OwnDraws, Rig, gentle_excitation, write_csv
from experiments.model_study.study import Study
from trms_cli.models.newtonian import Newtonian

#: Of noise and drift: of the recordings, and of the loops.
_RECORDING_SEED, _LOOP_SEED = 21, 22
#: Seeds of the commands of a judged recording lie beside those of the fitted one.
_OTHER_COMMANDS = 500
_NAME = "rig"
FITTED, OPEN_LOOP, CLOSED_LOOP = "fitted", "open_loop", "closed_loop"


@dataclass(frozen=True)
class DrawnRig:
    """A rig with all that is in no model."""

    rig: Rig
    nuisances: dict[str, float]
    effects: dict[str, float]  #: ``<effect>.<size>``

    @property
    def seed(self) -> int:
        return self.rig.seed


@dataclass(frozen=True)
class Recordings:
    """Files of a rig."""

    fitted: Path
    judged: tuple[Path, Path]  #: In open loop, under two PIDs
    largest: float  #: Largest angle of them over its stop


def draw_rig(study: Study, seed: int) -> DrawnRig:
    """A rig by its seed: parameters, sensors and drives, laws."""
    settings = study.rigs
    random = np.random.default_rng([seed, 19])
    nuisances = draw_nuisances(random) | imperfect_laws(random, settings.laws)
    parameters = Newtonian().parameters.draw(seed, settings.scatter)
    return DrawnRig(Rig(_NAME, {}, seed, parameters), nuisances, settings.effects)


def drive(
    rigs: Sequence[DrawnRig],
    driver: Driver,
    duration: float,
    step: float,
    *,
    among: Sequence[int],
    settling: float = 0.0,
    seed: int = _LOOP_SEED,
) -> RigRecordings:
    """Drive rigs at once, some of them several times; copies of one meet the same noise and drift.

    ``duration``, ``step``, ``settling``: s; see :meth:`experiments.gap.blind.rig.Rigs.run`.
    ``among``: seeds of all rigs that there are; with ``seed`` they determine what a rig meets.
    """

    def columns(values: Sequence[float]) -> np.ndarray:
        return np.array(values, dtype=float)

    constants = {
        name: columns([rig.rig.parameters[name].value for rig in rigs])
        for name in Newtonian().parameters.names
    }
    sizes = {name: columns([rig.effects[name] for rig in rigs]) for name in rigs[0].effects}
    nuisances = {name: columns([rig.nuisances[name] for rig in rigs]) for name in rigs[0].nuisances}
    draws = OwnDraws(seed, [among.index(rig.seed) for rig in rigs], len(among))
    # numpy takes a generator where it takes a seed
    own = Rigs(constants, sizes, Nuisances(**nuisances), seed=cast(int, draws))
    return own.run(driver, duration, step, settling)


def record(rigs: Sequence[DrawnRig], study: Study, folder: Path) -> dict[int, Recordings]:
    """Record what is fitted and what is judged, of all rigs at once; by seed."""
    settings = study.recordings
    step, seeds, n = settings.sample_time, [rig.seed for rig in rigs], len(rigs)
    durations = {
        FITTED: settings.fitted,
        OPEN_LOOP: settings.judged[0],
        CLOSED_LOOP: settings.judged[1],
    }
    longest = max(durations.values())
    references = square_references(seeds, round(longest / step), step)
    drivers: list[Driver] = [
        _excitation(seeds, longest, step),
        _excitation([seed + _OTHER_COMMANDS for seed in seeds], longest, step),
        CascadedPid(references, step),
    ]
    parts = [(np.arange(n, dtype=np.int64) + n * i, driver) for i, driver in enumerate(drivers)]
    recorded = drive(
        [*rigs] * len(parts),
        MixedDrivers(parts),
        longest,
        step,
        among=study.rigs.every,
        settling=settings.settling,
        seed=_RECORDING_SEED,
    )
    stops = np.array([Newtonian().stops[angle] for angle in ("alpha_v", "alpha_h")])
    recordings = {}
    for i, rig in enumerate(rigs):
        place = folder / str(rig.seed)
        place.mkdir(parents=True, exist_ok=True)
        files, largest = [], 0.0
        for k, (name, duration) in enumerate(durations.items()):
            samples = round(duration / step)
            part = RigRecordings(
                recorded.time[:samples],
                recorded.commands[:, :samples],
                recorded.measured[:, :samples],
            )
            files.append(write_csv(part, n * k + i, place / f"{name}.csv"))
            angles = np.abs(part.measured[n * k + i, :, :2])
            largest = max(largest, float(np.max(angles / stops)))
        recordings[rig.seed] = Recordings(files[0], (files[1], files[2]), largest)
    return recordings


def _excitation(seeds: Sequence[int], duration: float, step: float) -> OpenLoop:
    return OpenLoop(np.stack([gentle_excitation(seed, duration, step) for seed in seeds]))
