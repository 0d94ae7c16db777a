"""Reads logs for reports: a run's signals, events, score and words as plain data."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.core.errors import RecordingError
from trms_cli.core.wording import choice_labels
from trms_cli.runs.run_folder import LOG_NAME

if TYPE_CHECKING:
    from trms_cli.recordings.log_reader import LoggedRun
    from trms_cli.reporting.signals import RunReport

_MOST_TEXT = 2_000  # characters of a fact
#: Packages whose versions are named on a page.
_PACKAGES = ("trms", "python", "numpy", "casadi")


def read_run(path: Path, *, name: str = "") -> RunReport:
    """Read a log, complete or not.

    Parameters
    ----------
    path : Path
        The log's file.
    name : str
        What the run is called; by default its folder, or the file where that has another name.

    Raises
    ------
    RecordingError
        If it cannot be read, is no log of a run, or is larger than what is read.
    """
    from trms_cli.recordings.log_reader import read_log
    from trms_cli.reporting.signals import RunReport, limits_in

    log = read_log(path)
    texts = {key: str(value) for key, value in log.run.items()}
    return RunReport(
        name=name or name_of(path),
        tables=log.tables,
        score=_score(log),
        limits=limits_in(log),
        outcome=log.outcome,
        duration=log.duration_s,
        problems=log.problems,
        choices=_choices(texts, log.config),
        facts=_facts(log, texts, path),
        command=texts.get("command", "")[:_MOST_TEXT],
        repeat=f"trms run --from {shlex.quote(str(path))}" if log.config else "",
        config=log.config,
    )


def name_of(path: Path) -> str:
    """``…/first/run.mcap`` as ``first``, ``…/monday.mcap`` as ``monday``."""
    if path.name == LOG_NAME:
        return path.resolve().parent.name or path.stem
    return path.stem


def _score(log: LoggedRun) -> Mapping[str, Any]:
    """Scored afresh, as ``trms score`` does; what a log says of itself where that fails."""
    from trms_cli.scoring.score import score_log

    try:
        return score_log(log)
    except (RecordingError, ValueError, KeyError, IndexError, TypeError, AttributeError):
        return log.score


def _choices(texts: Mapping[str, str], config: str) -> dict[str, str]:
    choices = _json(texts, "choices")
    if not isinstance(choices, Mapping):
        return {}
    shown = choice_labels(choices, config)
    return {group: told[:_MOST_TEXT] for group, told in shown.items() if told not in ("", "none")}


def _facts(log: LoggedRun, texts: Mapping[str, str], path: Path) -> dict[str, str]:
    facts = {}
    for key, words in (("seed", "seed"), ("recording.file", "recording"), ("start", "begun")):
        if texts.get(key):
            facts[words] = texts[key][:_MOST_TEXT]
    if "begun" in facts:  # to the second
        facts["begun"] = re.sub(r"^(\S{10})T(\S{8})\.\d+\+00:00$", r"\1 \2 UTC", facts["begun"])
    facts["log"] = str(path)
    versions = _json(texts, "versions")
    if isinstance(versions, Mapping):
        told = [f"{name} {versions[name]}" for name in _PACKAGES if name in versions]
        if texts.get("git"):
            told.append(f"git {texts['git']}")
        facts["versions"] = ", ".join(told)[:_MOST_TEXT]
    return facts


def _json(texts: Mapping[str, str], key: str) -> Any:
    try:
        return json.loads(texts.get(key, "null"))
    except (ValueError, RecursionError):
        return None
