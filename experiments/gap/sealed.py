"""Diagnose a folder of recordings whose truth nobody told, and write the table of verdicts.

    python -m experiments.gap.sealed RECORDINGS OUT [--table FILE.md]

Each recording is diagnosed by ``trms diagnose real=FILE model=newtonian`` with normal effort into a
folder of its own; those that are there already are only read.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

HEAD = (
    "| recording | verdict | cause (probability) | next "
    "| where (share) | gap closed at 2 s | time |\n"
    "|---|---|---|---|---|---|---|\n"
)


def row(name: str, diagnosis: dict[str, Any]) -> str:
    """A line of the table."""
    causes = [
        f"{' + '.join(c['effects'])} ({c['probability']:.2f})" for c in diagnosis["causes"][:2]
    ]
    where = [f"{w['location']} ({w['share']:.2f})" for w in diagnosis["where"][:2]]
    shrink = (diagnosis["shrink"].get("all") or {}).get("2.0") or {}
    closed = "–"
    if any("." in key for key in diagnosis["causes"][0]["parameters"]) and shrink.get("fraction"):
        low, high = shrink["ci95"] or (float("nan"), float("nan"))
        closed = f"{100 * shrink['fraction']:.0f} % ({100 * low:.0f} to {100 * high:.0f})"
    time = sum(diagnosis["seconds"].values())
    cells = (name, diagnosis["verdict"], *causes, ", ".join(where) or "–", closed, f"{time:.0f} s")
    return "| " + " | ".join(cells) + " |\n"


def main() -> int:
    """Diagnose and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--table", type=Path)
    arguments = parser.parse_args()
    rows = []
    for file in sorted(arguments.recordings.glob("*.csv")):
        folder = arguments.out / file.stem
        document = folder / "diagnosis.json"
        if not document.exists():
            words = [f"real={file}", f"out={folder}", "model=newtonian"]
            subprocess.run([sys.executable, "-m", "trms_cli", "diagnose", *words], check=True)
        rows.append(row(file.stem, json.loads(document.read_text(encoding="utf-8"))))
    table = HEAD + "".join(rows)
    sys.stdout.write(table)
    if arguments.table is not None:
        arguments.table.write_text(table, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
