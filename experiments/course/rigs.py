"""``trms course rigs``: a sealed rig for each student."""

from __future__ import annotations

import secrets
import sys
from dataclasses import dataclass
from time import perf_counter
from typing import Annotated

from msgspec import Meta

from trms_cli.composition.composer import Composition
from trms_cli.core.errors import EXIT_OK
from trms_cli.core.plugins import construct

#: The set that rigs are drawn from, and what students' folders are called before their number.
SET, STEM = "course", "rig_"
#: Seeds that are drawn: too many to try them all.
_SEEDS = 2**48


@dataclass(frozen=True, kw_only=True)
class RigsOptions:
    """The keys of ``configs/course_rigs.yaml``."""

    out: str  #: Folder of the students' folders
    n: Annotated[int, Meta(ge=1, le=1000)] = 30
    seed: Annotated[int, Meta(ge=0)] | None = None  #: None: drawn
    duration: Annotated[float, Meta(ge=1, le=3600)] = 120.0  #: s
    sample_time: Annotated[float, Meta(ge=0.002, le=0.1)] = 0.02  #: s
    jobs: Annotated[int, Meta(ge=1)] = 2
    key: str | None = None  #: Folder of the key


def perform(composition: Composition) -> int:
    """Make the rigs that a configuration asks for."""
    from experiments.course.sheet import ANSWER, SHEET, form, task_sheet
    from experiments.gap.blind.make import check_sample_time, new_set_folders
    from experiments.gap.blind.recording import Timing
    from experiments.gap.blind.sealing import KEY, SetRequest, make
    from trms_cli.core.whole_file import replace_whole
    from trms_cli.models.newtonian import Newtonian

    begin = perf_counter()
    options = construct(RigsOptions, dict(composition.config))
    check_sample_time(options.sample_time)
    folder, key_folder = new_set_folders(options.out, options.key, "course")
    request = SetRequest(
        name=SET,
        seed=secrets.randbelow(_SEEDS) if options.seed is None else options.seed,
        cases=options.n,
        timing=Timing(duration=options.duration, sample_time=options.sample_time),
        fresh=0.0,
        jobs=options.jobs,
        stem=STEM,
        apart=True,
    )
    sys.stderr.write(f"{options.n} rigs move, many at once; some minutes\n")
    commitment = make(
        request, folder, key_folder, lambda digest: print(f"key  sha256 {digest}", flush=True)
    )
    model = Newtonian()
    for own in sorted(folder.glob(f"{STEM}*")):
        sheet = task_sheet(own.name, model, commitment, options.duration, options.sample_time)
        replace_whole(own / SHEET, sheet.encode())
        replace_whole(own / ANSWER, form(own.name).encode())
    print(f"{options.n} folders for students in {folder}, the key in {key_folder / KEY}")
    print(f"{perf_counter() - begin:.0f} s")
    print(f"then: trms course check in={folder} answers=FOLDER_OF_WHAT_THEY_HAND_IN")
    return EXIT_OK
