"""What is kept of many diagnoses: a line each, with the rig's truth and what was known of it.

``features.jsonl.gz`` holds JSON lines, each compressed by itself, so that one can be appended at
any time and a file that was cut off while it was written loses its last line alone.
"""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from msgspec import convert

from experiments.gap.blind.cases import Case
from trms_cli.core.whole_file import replace_whole

FILE_NAME = "features.jsonl.gz"
#: What of a ``diagnosis.json`` is kept: enough to judge it and to believe anew.
_DOCUMENT_KEYS = (
    "schema",
    "verdict",
    "where",
    "confusable",
    "not_testable",
    "inclusion",
    "moved",
    "evidence",
)
#: Causes less probable are not kept, nor the sizes of any but the first.
_LEAST = 1e-4


@dataclass(frozen=True, kw_only=True)
class Line:
    """A rig that was diagnosed, or could not be."""

    name: str
    case: Case
    document: Mapping[str, Any]  #: Parts of its ``diagnosis.json``; empty where there is none
    seconds: float | None = None  #: That the diagnosis took
    failed: str = ""  #: Why there is no diagnosis

    @property
    def evidence(self) -> Mapping[str, Any]:
        """What the probabilities were made of."""
        evidence: Mapping[str, Any] = self.document.get("evidence", {})
        return evidence


def line_of(
    name: str, case: Case, document: Mapping[str, Any], seconds: float | None = None
) -> Line:
    """What is kept of a diagnosis."""
    content = {key: document[key] for key in _DOCUMENT_KEYS if key in document}
    causes = sorted(document["causes"], key=lambda cause: -cause["probability"])
    content["causes"] = [
        cause if i == 0 else {**cause, "parameters": {}}
        for i, cause in enumerate(causes)
        if i == 0 or cause["probability"] >= _LEAST
    ]
    content["shrink"] = {"all": document.get("shrink", {}).get("all", {})}
    return Line(name=name, case=case, document=_rounded(content), seconds=seconds)


def _rounded(content: Any) -> Any:
    """Numbers with as many digits as anything is believed by."""
    if isinstance(content, float):
        return float(f"{content:.7g}")
    if isinstance(content, Mapping):
        return {key: _rounded(value) for key, value in content.items()}
    return [_rounded(item) for item in content] if isinstance(content, list | tuple) else content


class FeaturesFile:
    """Lines that can be appended to.

    Parameters
    ----------
    path : Path
        The file, or the folder that it lies in under its usual name.
    """

    def __init__(self, path: Path) -> None:
        self.path = path / FILE_NAME if path.suffix != ".gz" else path

    def lines(self) -> list[Line]:
        """All that are whole, the last of each name."""
        lines_by_name = {entry["name"]: convert(entry, Line) for entry in self._entries()}
        return list(lines_by_name.values())

    def append(self, line: Line) -> None:
        """Add a line at the end."""
        with self.path.open("ab") as file:
            file.write(_packed(line))

    def mend(self, *, without_failed: bool = False) -> list[Line]:
        """Write the lines anew, without one that was cut off; returns them.

        ``without_failed``: nor those of rigs that could not be diagnosed.
        """
        lines = [line for line in self.lines() if not (without_failed and line.failed)]
        if self.path.is_file():
            replace_whole(self.path, b"".join(_packed(line) for line in lines))
        return lines

    def _entries(self) -> Iterator[dict[str, Any]]:
        if not self.path.is_file():
            return
        try:
            with gzip.open(self.path, "rt", encoding="utf-8") as text:
                for row in text:
                    yield json.loads(row)
        except (EOFError, OSError, zlib.error, ValueError):
            return  # cut off here


def _packed(line: Line) -> bytes:
    text = json.dumps(asdict(line), separators=(",", ":"))
    return gzip.compress(text.encode() + b"\n", mtime=0)
