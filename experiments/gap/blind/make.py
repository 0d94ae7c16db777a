"""``trms blind make``: a sealed set."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta

from trms_cli.composition.composer import Composition
from trms_cli.core.errors import EXIT_OK, ConfigurationError
from trms_cli.core.plugins import construct, nearest

if TYPE_CHECKING:
    from experiments.gap.blind.model_set import RigSource

OWN = "own"  #: the set of a model of one's own
#: s. A rig is integrated in steps of this length, of which a sample is a whole number.
_STEP = 1e-3


@dataclass(frozen=True, kw_only=True)
class MakeOptions:
    """The keys of ``configs/blind_make.yaml``."""

    set: str | None  #: What the set holds; None: ``small``, or with a model ``own``
    out: str  #: folder of the recordings
    seed: Annotated[int, Meta(ge=0)] = 0
    cases: Annotated[int, Meta(ge=1)] | None = None  #: None: as many as the set has
    #: ``duration``, ``sample_time``, ``fresh``: s; without ``duration`` each recording has its own,
    #: ``fresh`` is that of the second recordings
    duration: Annotated[float, Meta(ge=1, le=3600)] | None = None
    sample_time: Annotated[float, Meta(ge=0.002, le=0.1)] = 0.02
    fresh: Annotated[float, Meta(ge=0, le=3600)] = 60.0
    jobs: Annotated[int, Meta(ge=1)] = 2
    key: str | None = None  #: Folder of the key


def perform(composition: Composition) -> int:
    """Make the set that a configuration asks for."""
    from experiments.gap.blind.recording import Timing
    from experiments.gap.blind.sealing import KEY, SetRequest, make
    from experiments.gap.blind.sets import SETS

    begin = perf_counter()
    keys = dict(composition.config)
    rigs = _rigs(keys.pop("model", None), keys.pop("data", None), composition.config_dirs)
    options = construct(MakeOptions, keys)
    name = options.set or ("small" if rigs is None else OWN)
    if name not in (SETS if rigs is None else (OWN,)):
        raise ConfigurationError(
            f"there is no set {name!r}" + (" of a model of your own" if rigs else ""),
            where="set",
            remedy=nearest(name, SETS if rigs is None else (OWN,)),
        )
    check_sample_time(options.sample_time)
    folder, key_folder = new_set_folders(options.out, options.key, "blind")
    request = SetRequest(
        name=name,
        seed=options.seed,
        cases=options.cases,
        timing=Timing(duration=options.duration, sample_time=options.sample_time),
        fresh=options.fresh,
        jobs=options.jobs,
        rigs=rigs,
    )
    whole = SETS[name].cases if rigs is None else rigs.cases
    number = whole if options.cases is None else options.cases
    sys.stderr.write(f"{number} rigs move, many at once; some minutes\n")
    make(request, folder, key_folder, lambda digest: print(f"key  sha256 {digest}", flush=True))
    print(f"{number} recordings in {folder}, the key in {key_folder / KEY}")
    print(f"{perf_counter() - begin:.0f} s")
    print(f"then: trms blind run in={folder} out={folder}.found")
    return EXIT_OK


def check_sample_time(sample_time: float) -> None:
    """Raise ConfigurationError unless a sample (s) is a whole number of the rigs' steps."""
    steps = sample_time / _STEP
    if abs(steps - round(steps)) > 1e-6:
        raise ConfigurationError(
            f"{sample_time:g} s given",
            where="sample_time",
            remedy=f"give a whole number of milliseconds, as {round(steps) * _STEP:g}",
        )


def new_set_folders(out: str, key: str | None, what: str) -> tuple[Path, Path]:
    """The folder of a set and that of its key, both new and the one not within the other.

    ``what``: the command, as :func:`trms_cli.runs.run_folder.new_folder` has it. Raises
    ConfigurationError where the key would be handed out with the recordings, TrmsError for a folder
    that cannot be written into or holds something.
    """
    from trms_cli.runs.run_folder import new_folder

    folder = Path(out).expanduser()
    key_folder = key_folder_of(folder, key)
    if key_folder.resolve().is_relative_to(folder.resolve()):
        raise ConfigurationError(
            f"{str(key_folder)!r} lies among the recordings",
            where="key",
            remedy="whoever diagnoses must not have the key: name a folder elsewhere",
        )
    return new_folder(folder, what), new_folder(key_folder, what)


def _rigs(model: Any, data: Any, config_dirs: Sequence[Path]) -> RigSource | None:
    """What rigs of a model of one's own are drawn from; None: they are TRMSs."""
    if model is None:
        return None
    from experiments.gap.blind.model_set import RigSource
    from trms_cli.core.plugins import build
    from trms_cli.library.tasks.diagnose import candidates_of

    own = build(model, "model")
    if own.bench_sizes:
        raise ConfigurationError(
            f"{own.name} is a model of the TRMS, whose rigs have code of their own",
            where="model",
            remedy="leave out model=, and name a set: set=small",
        )
    noise, quantum = ((data or {}).get(key) for key in ("noise_sd", "quantum"))
    return RigSource(
        own,
        candidates_of(["all"], own, config_dirs).effects,
        noise if isinstance(noise, Mapping) else {},
        quantum or {},
    )


def key_folder_of(folder: Path, key: str | None) -> Path:
    """Where the key of a set lies: as asked, else beside its recordings."""
    return folder.with_name(f"{folder.name}.key") if key is None else Path(key).expanduser()
