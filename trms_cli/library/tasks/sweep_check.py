"""Looks at one run of each value that a sweep tries, before the first run is made.

A key that one of the controllers lacks, or a duration that is no number, would fail each run of
its kind: it is told at once, and nothing is written. Each value is tried with the first of all
others, so that the effort grows with the number of values and not with that of combinations.
Parts of this program are built as a run builds them; a user's own code runs in workers only.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from trms_cli.core.errors import TrmsError
from trms_cli.core.plugins import TARGET
from trms_cli.sweeps.space import Space

#: Values of one key that are looked at, from the first on; the last is, too.
MOST_VALUES = 30
_OURS = "trms_cli."
_NUMBERS = ("duration", "sample_time")


def check_choices(space: Space, primary: str, config_dirs: tuple[Path, ...]) -> None:
    """Compose a run of each value, and build what is cheap and safe to build.

    Parameters
    ----------
    space : Space
    primary : str
        Primary configuration of the runs.
    config_dirs : tuple of Path
        The user's folders of options.

    Raises
    ------
    TrmsError
        For the first value that no run can be made with; it names the value.
    """
    from trms_cli.composition.composer import composer_of

    composer = composer_of(primary, config_dirs)
    seen: set[str] = set()
    for word, overrides in _runs(space):
        try:
            composition = composer.compose(overrides)
            if primary == "run":
                _check_run(composition.config, seen)
        except TrmsError as error:
            if word:
                error.problem = f"{error.problem} (in the runs with {word})"
                error.args = (error.problem,)
            raise


def _runs(space: Space) -> Iterator[tuple[str, tuple[str, ...]]]:
    """What a run has of its own, and its overrides."""
    from trms_cli.composition.sweep_space import first_of

    first = first_of(space)
    yield "", first
    for place, choice in enumerate(space.choices, start=len(space.fixed)):
        values = choice.values[1:]
        if len(values) > MOST_VALUES:
            values = (*values[: MOST_VALUES - 1], values[-1])
        for value in values:
            word = f"{choice.key}={value}"
            yield word, (*first[:place], word, *first[place + 1 :])


def _check_run(config: Mapping[str, Any], seen: set[str]) -> None:
    """What a run would refuse before its first step."""
    from trms_cli.composition.plain_values import check_files, number, whole_number
    from trms_cli.core.plugins import build
    from trms_cli.library.tasks import experiment as assembly
    from trms_cli.library.tasks.replay import is_replay

    if is_replay(config):
        return
    check_files(config)
    for name in _NUMBERS:
        number(config["sim"][name], f"sim.{name}")
    whole_number(config["seed"], "seed")
    whole_number(config["sim"]["prediction_every"], "sim.prediction_every")
    for key in ("model", *assembly.PARTS):
        node = json.dumps([key, config[key]], default=str)
        if node in seen or not _is_ours(config[key]):
            continue
        seen.add(node)
        try:
            build(config[key], key)
        except TrmsError:
            raise
        except Exception:  # a fault of the part itself: the run tells it, with its trace
            continue


def _is_ours(node: Any) -> bool:
    """Whether all that a part is built of belongs to this program."""
    if isinstance(node, Mapping):
        target = node.get(TARGET)
        if target is not None and not str(target).startswith(_OURS):
            return False
        return all(map(_is_ours, node.values()))
    return all(map(_is_ours, node)) if isinstance(node, (list, tuple)) else True
