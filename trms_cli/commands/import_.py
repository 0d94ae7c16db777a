"""``trms import``: a lab's recording, checked and turned into an MCAP log."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from trms_cli.commands.plain_options import PlainOptions

SUMMARY = "turn a recording (CSV, MAT) into an MCAP log"

HELP = """\
usage: trms import FILE [--out LOG.mcap] [--force] [--json]

Checks a recording and writes it as an MCAP log, which `trms score`, `trms run plant=replay`,
Foxglove and every other MCAP reader open. Prints what is in it: channels with units, span,
rate, gaps, missing samples and quanta. The first fault found is told with its line and what
to do about it; nothing is repaired in silence.

  FILE           a recording, .csv or .mat
  --out LOG      where to write the log (default: FILE's name, ending in .mcap, in the
                 working directory: a folder of recordings is often shared)
  --force        replace LOG if it exists
  --json         print the same figures as JSON

A CSV is a header of name[unit] and numbers below; lines with # above are key: value metadata:

  # rig: my twin rotor
  t[s],u_v[V],u_h[V],alpha_v[deg],alpha_h[deg]
  0.00,0,0,-28.1,0.0

Names: t, u_v u_h (main and tail rotor input), alpha_v alpha_h (pitch, yaw), omega_v omega_h
(rotor speeds), r_v r_h (references), i_v i_h (currents), d_* (known disturbances). t, one
input and one output are required. Any unit that fits is converted: deg, rpm, ms, mV, %, 1, …
An empty cell is a missing sample. A MAT file holds vectors of these names in SI units, or a
struct `units` that says otherwise: units.alpha_v = 'deg'; or it is an export of `trms export`.

examples
  trms import recording.csv
  trms import recording.csv --out logs/monday.mcap
  trms import recording.csv --json
"""


def main(argv: list[str]) -> int:
    """Run the command; return the exit code."""
    options = PlainOptions("trms import", HELP)
    options.add_argument("file", type=Path)
    options.add_argument("--out", type=Path)
    options.add_argument("--force", action="store_true")
    options.add_argument("--json", action="store_true")
    given = options.parse_args(argv)

    from trms_cli.core.errors import RecordingError
    from trms_cli.recordings.mcap_recording import sha256_of, write_mcap
    from trms_cli.recordings.recording import read_recording

    if given.file.suffix.lower() == ".mcap":
        raise RecordingError(
            "this is a log already", where=str(given.file), remedy="trms export turns it into CSV"
        )
    recording = read_recording(given.file)
    log_path = given.out or Path(given.file.with_suffix(".mcap").name)
    sha256 = sha256_of(given.file)
    run_metadata = {
        "command": "trms import",
        "imported": "true",
        "file": str(given.file),
        "file_sha256": sha256,
    }
    write_mcap(recording, log_path, run_metadata, force=given.force)

    document = _document(recording, given.file, log_path, sha256)
    if given.json:
        json.dump(document, sys.stdout, indent=2, ensure_ascii=False)
        sys.stdout.write("\n")
    else:
        _print(document)
    return 0


def _document(recording: Any, file: Path, log: Path, sha256: str) -> dict[str, Any]:
    """Return the JSON twin of what is printed, in SI units."""
    import numpy as np

    from trms_cli.recordings.recording import quantum

    channels = {}
    for name, values in recording.channels.items():
        there = values[np.isfinite(values)]
        channels[name] = {
            "unit": recording.units[name],
            "min": float(there.min()) if len(there) else None,
            "max": float(there.max()) if len(there) else None,
            "quantum": quantum(values),
            "missing": recording.missing.get(name, 0),
        }
    return {
        "schema": "trms.import/1",
        "file": str(file),
        "sha256": sha256,
        "log": str(log),
        "metadata": recording.metadata,
        "samples": len(recording),
        "start_s": float(recording.time[0]),
        "end_s": float(recording.time[-1]),
        "duration_s": recording.duration_s,
        "sample_time_s": recording.sample_time,
        "rate_hz": 1 / recording.sample_time,
        "gaps": [{"start_s": start, "end_s": end} for start, end in recording.gaps],
        "channels": channels,
        "notes": recording.notes(),
    }


def _print(document: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(highlight=False, soft_wrap=True)
    console.print(
        f"{escape(document['file'])}: {document['samples']} samples "
        f"from {document['start_s']:.6g} to {document['end_s']:.6g} s, "
        f"{document['rate_hz']:.6g} Hz, {len(document['gaps']) or 'no'} gap"
        f"{'' if len(document['gaps']) == 1 else 's'}"
    )
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("channel")
    table.add_column("unit")
    for heading in ("min", "max", "quantum", "missing"):
        table.add_column(heading, justify="right")
    for name, row in document["channels"].items():
        figures = (_figure(row[key]) for key in ("min", "max", "quantum"))
        table.add_row(name, row["unit"], *figures, str(row["missing"]))
    console.print(table)
    for note in document["notes"]:
        console.print(f"note: {escape(note)}")
    console.print(f"log: {escape(document['log'])}")


def _figure(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"
