"""Published figures of other authors, and ours under their conditions where we can repeat these."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import yaml

from experiments.tournament.schedule import HERE, Run
from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.core.resources import config_folder

PUBLISHED = HERE / "published.yaml"
#: The set whose limits are replaced.
_PARAMETER_SET = "bench"


class Figure(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A figure of a score: which, and how it is told."""

    channel: str
    figure: str
    words: str
    unit: str


class Ours(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A run under somebody's conditions."""

    words: list[str]
    figures: list[Figure]
    note: str = ""
    limits: dict[str, float] = {}


class PublishedResult(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """What somebody published."""

    author: str
    condition: str
    rig: str
    theirs: str
    ours: Ours | None = None


@dataclass(frozen=True, kw_only=True)
class Beside:
    """A published figure and ours."""

    published: PublishedResult
    #: Our figures with their units, by words; None for what did not happen
    figures: dict[str, tuple[float | None, str]]
    problem: str = ""  #: Why our run failed; "" if it did not


def read_published(path: Path = PUBLISHED) -> list[PublishedResult]:
    """Read the list.

    Raises ConfigurationError if the file is none.
    """
    try:
        return msgspec.convert(
            yaml.safe_load(path.read_text(encoding="utf-8")), list[PublishedResult]
        )
    except (OSError, yaml.YAMLError, msgspec.ValidationError) as error:
        raise ConfigurationError(
            f"this is no list of published figures: {str(error).splitlines()[0]}", where=str(path)
        ) from error


def put_beside(published: PublishedResult, folder: Path) -> Beside:
    """Run what can be repeated; never raises for a run that fails.

    ``folder``: for a parameter set with other limits.
    """
    ours = published.ours
    if ours is None:
        return Beside(published=published, figures={})
    from experiments.tournament.worker_runs import score_in_memory

    run = Run(
        controller="newton_mpc",
        observer="ukf",
        ref="published",
        rig=published.author,
        rig_class="published",
        blocks=("published",),
        entrant_words=("controller=newton_mpc", "observer=ukf"),
        ref_words=(*ours.words, *_with_limits(ours.limits, folder)),
        rig_words=(),
        every=("sim.prediction_every=0",),
    )
    try:
        score, _ = score_in_memory(run, folder)
    except TrmsError as error:
        return Beside(published=published, figures={}, problem=error.problem)
    values = {
        figure.words: (score["channels"][figure.channel][figure.figure], figure.unit)
        for figure in ours.figures
    }
    return Beside(published=published, figures=values)


def _with_limits(limits: dict[str, float], folder: Path) -> list[str]:
    """The parameter set with other limits, as a file of its own."""
    if not limits:
        return []
    source = Path(config_folder()) / "parameters" / f"{_PARAMETER_SET}.yaml"
    content: dict[str, Any] = yaml.safe_load(source.read_text(encoding="utf-8"))
    content["limits"] = content["limits"] | limits
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{_PARAMETER_SET}_with_limits.yaml"
    path.write_text(yaml.safe_dump(content, allow_unicode=True), encoding="utf-8")
    return [f"model.parameter_set='{path.resolve()}'"]
