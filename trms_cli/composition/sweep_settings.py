"""The overrides that steer a sweep itself: they are taken off those of its runs.

``sampler=…``, ``launcher.workers=4`` and ``retries=2`` are composed from the primary configuration
``sweep``; ``out=FOLDER`` names the sweep's folder; the rest belongs to the runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from trms_cli.composition.catalogue import Groups, Primary, read_groups, read_primary
from trms_cli.composition.composer import compose
from trms_cli.composition.overrides import parse
from trms_cli.composition.plain_values import value_at, whole_number
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build

PRIMARY = "sweep"
#: What the runs of a sweep are given unless it is typed: nobody looks at a thousand pictures.
_OF_RUNS = {"run": {"picture": "false", "sim.scene_every": "0"}}
#: What Hydra's own keys were for, and what to write instead.
_INSTEAD = {
    "hydra/launcher": "choose where runs are made: launcher=local, launcher=dask, launcher=slurm "
    "(`trms list launcher`)",
    "hydra/sweeper": "choose how values are chosen: sampler=grid, sampler=latin_hypercube, … "
    "(`trms list sampler`)",
    "hydra.launcher": "write launcher.workers=4; `trms list launcher local` tells the keys",
    "hydra.sweeper": "write sampler.samples=100; `trms list sampler` tells the samplers",
    "hydra.sweep": "write out=FOLDER",
}


class Divided(NamedTuple):
    """The overrides of ``-m``."""

    runs: tuple[str, ...]
    settings: tuple[str, ...]  #: of the sweep
    out: str | None  #: its folder; None: a dated one


class Settings(NamedTuple):
    """What steers a sweep, composed."""

    sampler: dict[str, Any]
    launcher: dict[str, Any]
    retries: int


def divided(overrides: Sequence[str], primary: str, config_dirs: Sequence[Path]) -> Divided:
    """Take the sweep's own overrides off.

    Raises ConfigurationError for Hydra's own keys; it tells what to write instead.
    """
    groups = read_groups(config_dirs)
    own = names_of(read_primary(PRIMARY, config_dirs))
    runs: list[str] = []
    settings: list[str] = []
    out: str | None = None
    for text in overrides:
        override = parse(text, groups)
        first = override.key.split(".")[0].split("/")[0]
        if first == "hydra":
            raise _of_hydra(text)
        if first in own:
            settings.append(text)
        elif override.key == "out":
            value = (override.value or "").strip("'\"")
            out = None if value in ("", "null") else value
        else:
            runs.append(text)
    return Divided((*_added(runs, primary, groups, config_dirs), *runs), tuple(settings), out)


def names_of(declared: Primary) -> set[str]:
    """First names of the sweep's own keys."""
    return {*declared.defaults, *declared.body}


def settings_of(settings: Sequence[str], config_dirs: Sequence[Path]) -> Settings:
    """Compose what steers the sweep; raises ConfigurationError for the first key that is wrong."""
    for text in settings:
        value = text.partition("=")[2]
        if "," in value and value[:1] not in "[{'\"":
            raise ConfigurationError(
                f"{value!r} are alternatives, and a sweep has one",
                where=text.partition("=")[0],
                remedy="make two sweeps",
            )
    config = compose(settings, PRIMARY, config_dirs=config_dirs).config
    retries = whole_number(config["retries"], "retries")
    return Settings(config["sampler"], config["launcher"], retries)


def built(settings: Settings) -> tuple[Any, Any]:
    """The sampler and the launcher; raises ConfigurationError for the first key that is wrong."""
    return build(settings.sampler, "sampler"), build(settings.launcher, "launcher")


def _added(
    typed: Sequence[str], primary: str, groups: Groups, config_dirs: Sequence[Path]
) -> list[str]:
    """What is laid under the typed overrides of the runs."""
    keys = {parse(text, groups).key for text in typed}
    declared = read_primary(primary, config_dirs)
    found = []
    for key, value in _OF_RUNS.get(primary, {}).items():
        if value_at(declared.body, key) is not None and key not in keys:
            found.append(f"{key}={value}")
    return found


def _of_hydra(text: str) -> ConfigurationError:
    key = text.partition("=")[0].lstrip("+~")
    remedy = next(
        (words for begin, words in _INSTEAD.items() if key.startswith(begin)),
        "sweeps have keys of their own: sampler, launcher, retries, out (`trms help sweep`)",
    )
    return ConfigurationError("Hydra's own keys steer nothing here", where=key, remedy=remedy)
