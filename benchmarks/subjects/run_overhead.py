"""A run inside a process that makes many: what it costs besides its loop."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.document import LIMIT, Column, Table
from benchmarks.options import Options
from benchmarks.setups import experiment
from benchmarks.setups import run as run_in_memory
from trms_cli.commands import run as command
from trms_cli.composition.composer import Composition, compose
from trms_cli.library.tasks import run as task
from trms_cli.simulation.closed_loop import Loop

TITLE = "a run of 60 s with pid in a process that makes many"
#: ms, of one core: a thousand runs in a minute on two.
LIMIT_RUN = 120.0
#: Set-up, score and all else but the log, as a share of the loop.
LIMIT_BESIDES = 0.5
_REPEATS = 15
#: Runs that fill what a process keeps, and do not count.
_WARM_UP = 2
_WORDS = ("controller=pid", "ref=square", "picture=false")
_PARTS = ("setup", "loop", "score", "rest", "whole")


def run(options: Options) -> list[Table]:
    """Runs of drawn rigs one after another, each beside its loop alone in memory."""
    last = _WARM_UP + (2 if options.quick else _REPEATS)
    words = (*_WORDS, f"sim.duration={options.duration(60.0):g}")
    plain, alone, viewed = [], [], []
    with tempfile.TemporaryDirectory() as scratch:
        # as runs of a sweep are logged
        of_sweep = ("sim.scene_every=0", "sim.estimate_every=10")
        first = _Worker(Path(scratch) / "plain", (*words, *of_sweep))
        view_worker = _Worker(Path(scratch) / "shown", words)
        beginning = first.run(0)["whole"]
        for number in range(1, last):
            plain.append(first.run(number))
            alone.append(_loop_in_memory(words, number))
            viewed.append(view_worker.run(number)["whole"])
    of = {part: _median([each[part] for each in plain]) for part in _PARTS}
    loop = _median(alone)
    table = Table(
        "run_overhead",
        TITLE,
        [
            Column("part", "part"),
            Column("time", "processor", "ms"),
            Column("share", "of the loop"),
            *LIMIT,
        ],
    )
    for part, time in (
        ("the loop itself, kept in memory", loop),
        ("its log", of["loop"] - loop),
        ("set-up: plugins, equations, designs, the log's head", of["setup"]),
        ("score", of["score"]),
        ("the rest: end of the log, documents, screen", of["rest"]),
    ):
        table.add(part=part, time=time, share=time / loop)
    table.add_limited(
        "share",
        (of["whole"] - of["loop"]) / loop,
        LIMIT_BESIDES,
        part="all but loop and log",
        time=of["whole"] - of["loop"],
    )
    whole = of["whole"]
    table.add_limited("time", whole, LIMIT_RUN, part="a run in all", share=whole / loop)
    view = _median(viewed)
    table.add(part="the same with the 3D view in its log", time=view, share=view / loop)
    table.add(part="the first run of the process", time=beginning, share=beginning / loop)
    table.notes += [
        "Medians of processor time on one core; the rig is drawn anew for each run. Composing the "
        "configuration is not in it: a sweep composes once.",
        f"Limits: {LIMIT_RUN:g} ms a run (1000 runs in a minute on two cores), and "
        f"{LIMIT_BESIDES:g} of the loop for all that is neither loop nor log.",
    ]
    return [table]


class _Worker:
    """A process' runs of one composition, varied in seed and rig."""

    def __init__(self, folder: Path, words: tuple[str, ...]) -> None:
        self._folder, self._base = folder, compose(list(words))

    def run(self, number: int) -> dict[str, float]:
        """One run; processor time by part, ms."""
        composition = _varied(self._base, number, self._folder / str(number))
        spent = dict.fromkeys(_PARTS, 0.0)
        begin = process_time()

        def timed(part: str, work: Callable[..., Any]) -> Callable[..., Any]:
            def measured(*arguments: Any, **options: Any) -> Any:
                start = process_time()
                if part == "loop":
                    spent["setup"] = 1e3 * (start - begin)
                try:
                    return work(*arguments, **options)
                finally:
                    spent[part] = 1e3 * (process_time() - start)

            return measured

        with (
            Path(os.devnull).open("w") as nowhere,
            redirect_stdout(nowhere),
            patch.dict(os.environ, {"TRMS_RUNS": "off"}),
            patch.object(Loop, "run", timed("loop", Loop.run)),
            patch.object(task, "score_of", timed("score", task.score_of)),
        ):
            command.perform(composition)
        spent["whole"] = 1e3 * (process_time() - begin)
        spent["rest"] = spent["whole"] - sum(spent[part] for part in ("setup", "loop", "score"))
        return spent


def _varied(base: Composition, number: int, folder: Path) -> Composition:
    config = deepcopy(base.config)
    config["seed"] = config["plant"]["prior_seed"] = number
    config["out"] = str(folder)
    return replace(base, config=config)


def _loop_in_memory(words: tuple[str, ...], number: int) -> float:
    """Processor time of the loop of one run without a log, ms."""
    spent = []
    work = Loop.run

    def measured(loop: Loop) -> None:
        start = process_time()
        work(loop)
        spent.append(1e3 * (process_time() - start))

    loop_setup = experiment(*words, f"seed={number}", f"plant.prior_seed={number}")
    with patch.object(Loop, "run", measured):
        run_in_memory(loop_setup)
    return spent[0]


def _median(values: list[float]) -> float:
    """Of what counts: the run before the first of these has warmed up too."""
    return float(np.median(values[_WARM_UP - 1 :]))
