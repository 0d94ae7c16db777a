"""A job of a sweep that failed before it had a log, as a row of the index.

Of such a job there is only the word of the sweep: ``status.json`` (``trms.status/1``) in its
folder, with what was typed and why it failed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trms_cli.core.errors import RecordingError
from trms_cli.runs.columns import COLUMNS
from trms_cli.runs.entry import IndexEntry, cells, choices_of_run, typed

STATUS_NAME = "status.json"
_SCHEMA = "trms.status/1"
_LONGEST = 2**20  # bytes


def read_status(path: Path) -> IndexEntry | None:
    """Read the row of a job; None for a file of this name that is somebody else's.

    Raises RecordingError if the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            document = json.loads(file.read(_LONGEST))
    except OSError as error:
        reason = error.strerror or error
        raise RecordingError(f"it cannot be read ({reason})", where=str(path)) from error
    except (ValueError, RecursionError):
        return None
    if not isinstance(document, Mapping) or document.get("schema") != _SCHEMA:
        return None
    given = document.get("overrides")
    overrides = [str(word) for word in given] if isinstance(given, list) else []
    keys = typed(overrides)
    choices = document.get("choices")
    if not isinstance(choices, Mapping):
        choices = {key: value for key, value in keys.items() if "." not in key}
    ended = document.get("state") in ("failed", "done")
    values: dict[str, Any] = dict.fromkeys(COLUMNS) | {
        "path": str(path.parent),
        "log": str(path),
        "outcome": "failed" if ended else "unfinished",
        "complete": False,
        "problem": _problem(document.get("error")),
        **choices_of_run(choices),
        "seed": keys.get("seed"),
        "overrides": json.dumps(overrides, ensure_ascii=False),
        "choices": json.dumps(choices, ensure_ascii=False),
    }
    return IndexEntry(str(path), cells(values), keys)


def _problem(error: Any) -> str | None:
    """The sentence of an error: text, or a mapping with the problem."""
    if isinstance(error, Mapping):
        error = " ".join(str(error[key]) for key in ("where", "problem") if error.get(key))
    return str(error) if error else None
