"""``trms blind make``: a sealed set."""

from __future__ import annotations

import sys
from pathlib import Path
from time import perf_counter

from trms_cli.commands.blind import MakeOptions, options_of
from trms_cli.composition.composer import Composition
from trms_cli.core.errors import EXIT_OK, ConfigurationError
from trms_cli.core.plugins import nearest

#: s. A rig is integrated in steps of this length, of which a sample is a whole number.
_STEP = 1e-3


def perform(composition: Composition) -> int:
    """Make the set that a configuration asks for."""
    from experiments.gap.blind.cases import SETS
    from experiments.gap.blind.recording import Timing
    from experiments.gap.blind.sealing import KEY, SetRequest, make
    from trms_cli.runs.run_folder import new_folder

    begin = perf_counter()
    options = options_of(MakeOptions, composition.config)
    if options.set not in SETS:
        raise ConfigurationError(
            f"there is no set {options.set!r}", where="set", remedy=nearest(options.set, SETS)
        )
    steps = options.sample_time / _STEP
    if abs(steps - round(steps)) > 1e-6:
        raise ConfigurationError(
            f"{options.sample_time:g} s given",
            where="sample_time",
            remedy=f"give a whole number of milliseconds, as {round(steps) * _STEP:g}",
        )
    folder = Path(options.out).expanduser()
    key_folder = key_folder_of(folder, options.key)
    if key_folder.resolve().is_relative_to(folder.resolve()):
        raise ConfigurationError(
            f"{str(key_folder)!r} lies among the recordings",
            where="key",
            remedy="whoever diagnoses must not have the key: name a folder elsewhere",
        )
    new_folder(folder, "blind")
    new_folder(key_folder, "blind")
    asked = SetRequest(
        name=options.set,
        seed=options.seed,
        cases=options.cases,
        timing=Timing(duration=options.duration, sample_time=options.sample_time),
        fresh=options.fresh,
        jobs=options.jobs,
    )
    number = SETS[options.set].cases if options.cases is None else options.cases
    sys.stderr.write(f"{number} rigs move for {options.duration:g} s all at once; some minutes\n")
    make(asked, folder, key_folder, lambda digest: print(f"key  sha256 {digest}", flush=True))
    print(f"{number} recordings in {folder}, the key in {key_folder / KEY}")
    print(f"{perf_counter() - begin:.0f} s")
    print(f"then: trms blind run in={folder} out={folder}.found")
    return EXIT_OK


def key_folder_of(folder: Path, key: str | None) -> Path:
    """Where the key of a set lies: as asked, else beside its recordings."""
    return folder.with_name(f"{folder.name}.key") if key is None else Path(key).expanduser()
