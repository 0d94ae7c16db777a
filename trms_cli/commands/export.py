"""``trms export``: a run's MCAP log as CSV, Parquet or MAT."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from trms_cli.commands.plain_options import PlainOptions
from trms_cli.commands.run_folder import log_of

SUMMARY = "turn an MCAP log into CSV, Parquet or MAT"

FORMATS = ("csv", "parquet", "mat")

HELP = """\
usage: trms export LOG [--format csv|parquet|mat] [--out FILE] [--force] [--json]

Writes a run's log for programs that read no MCAP. The log of a run that died is written as
far as it goes. The file appears when it is whole; nothing is overwritten unless told so.

  LOG            an MCAP log of trms, or the folder of a run
  --format NAME  csv      inputs, outputs and references on the sample grid, as `trms import`
                          and `plant=replay` read it
                 parquet  one wide table of all topics, a row per sample time, columns
                          topic.field, units in the fields' metadata; events as lists
                 mat      a struct per topic, units beside the values
                 (default: what the ending of --out tells, else csv)
  --out FILE     where to write (default: beside LOG, with the format's ending)
  --force        replace FILE if it exists
  --json         print what was written as JSON

examples
  trms export outputs/2025-01-31/run.mcap
  trms export run.mcap --format parquet
  trms export run.mcap --out for_matlab.mat --force
"""


def main(argv: list[str]) -> int:
    """Run the command; return the exit code."""
    options = PlainOptions("trms export", HELP)
    options.add_argument("log", type=Path)
    options.add_argument("--format", choices=FORMATS)
    options.add_argument("--out", type=Path)
    options.add_argument("--force", action="store_true")
    options.add_argument("--json", action="store_true")
    given = options.parse_args(argv)
    given.log = log_of(given.log)
    format_ = given.format or _format_of(given.out)
    out = given.out or given.log.with_suffix(f".{format_}")

    from trms_cli.recordings.export import export_log
    from trms_cli.recordings.log_reader import read_log

    log = read_log(given.log)
    export_log(log, out, format_, force=given.force)

    topics = {name: len(table) for name, table in log.tables.items() if len(table)}
    if given.json:
        document = {
            "schema": "trms.export/1",
            "log": str(given.log),
            "complete": log.complete,
            "problems": list(log.problems),
            "format": format_,
            "file": str(out),
            "duration_s": log.duration_s,
            "topics": topics,
        }
        json.dump(document, sys.stdout, indent=2, ensure_ascii=False)
        sys.stdout.write("\n")
        return 0
    for problem in log.problems:
        print(f"note: {given.log}: {problem}")
    messages = ", ".join(f"{count} of {name}" for name, count in topics.items())
    print(f"{given.log}: {log.duration_s:.6g} s; messages: {messages}")
    print(f"{format_}: {out}")
    return 0


def _format_of(out: Path | None) -> str:
    ending = out.suffix.lower().lstrip(".") if out else ""
    return ending if ending in FORMATS else "csv"
