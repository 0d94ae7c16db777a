"""``trms import``: a lab's recording, checked and turned into an MCAP log."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from trms_cli.commands.plain_options import PlainOptions
from trms_cli.core.printable import print_json

SUMMARY = "turn a recording (CSV, MAT) into an MCAP log"

HELP = """\
usage: trms import FILE [--out LOG.mcap] [--force] [--json] [PREPARATION]…

Checks a recording and writes it as an MCAP log, which `trms score`, `trms run plant=replay`,
`trms identify`, Foxglove and every other MCAP reader open. Prints what is in it: channels with
units, span, rate, gaps, missing samples, quanta, outliers, delays between channels, and whether
the loop was open or closed; of inputs the share of time at the limit, of angles that at rest,
and how often an angle or a rotor turns round. By the model of the rig it tells angles that seem
swapped, turned round, or counted from where the beam hung when it was switched on. The first
fault found is told with its line and what to do about it; nothing is repaired in silence.

  FILE           a recording, .csv or .mat
  --out LOG      where to write the log (default: FILE's name, ending in .mcap, in the
                 working directory: a folder of recordings is often shared)
  --force        replace LOG if it exists
  --json         print the same figures as JSON

preparation: done only when asked for, in this order, and noted in the log
  --outliers mark        make outliers missing samples (default: keep)
  --delay NAME=SECONDS   the channel is recorded so much late: move it earlier (may be repeated;
                         negative: a command that is written down before it acts)
  --gaps split|SECONDS   a log of each part between gaps of t, or fill what is missing for at
                         most SECONDS (default: keep)
  --resample SECONDS     another sample time: commands averaged, measurements low-passed

A CSV is a header of name[unit] and numbers below; lines with # above are key: value metadata:

  # rig: my twin rotor
  t[s],u_v[V],u_h[V],alpha_v[deg],alpha_h[deg]
  0.00,0,0,-28.1,0.0

Names: t, u_v u_h (main and tail rotor input), alpha_v alpha_h (pitch, yaw), omega_v omega_h
(rotor speeds), r_v r_h (references), i_v i_h (currents), d_* (known disturbances). t, one
input and one output are required. Any unit that fits is converted: deg, rpm, ms, mV, %, 1, …
Pitch is 0 where the beam is level and positive upwards: at rest it hangs at some -0.6 rad. (One
that reads 0 there: data.offset of `trms identify`.) An empty cell is a missing sample. A MAT file
holds vectors of these names in SI units, or a struct `units` that says otherwise:
units.alpha_v = 'deg'; or it is an export of `trms export`.

examples
  trms import recording.csv
  trms import recording.csv --out logs/monday.mcap
  trms import recording.csv --json
  trms import recording.csv --outliers mark --delay alpha_v=0.02 --resample 0.02
"""


def main(argv: list[str]) -> int:
    """Run the command; return the exit code."""
    options = PlainOptions("trms import", HELP)
    options.add_argument("file", type=Path)
    options.add_argument("--out", type=Path)
    options.add_flags("--force", "--json")
    options.add_argument("--outliers", choices=("keep", "mark"), default="keep")
    options.add_argument("--delay", action="append", default=[], metavar="NAME=SECONDS")
    options.add_argument("--gaps", default="keep")
    options.add_argument("--resample", type=float)
    arguments = options.parse_args(argv)

    from trms_cli.core.errors import RecordingError
    from trms_cli.identification.loop_state import find_loop
    from trms_cli.identification.rotor_delays import estimate_delays
    from trms_cli.recordings.mcap_recording import sha256_of, write_mcap
    from trms_cli.recordings.read import read_recording
    from trms_cli.recordings.summary import summarise

    if arguments.file.suffix.lower() == ".mcap" and _is_log(arguments.file):
        raise RecordingError(
            "this is a log already",
            where=str(arguments.file),
            remedy="trms export turns it into CSV",
        )
    preparation = _preparation(arguments)
    recording = read_recording(arguments.file)
    log_path = arguments.out or Path(arguments.file.with_suffix(".mcap").name)
    sha256 = sha256_of(arguments.file)
    summary = summarise(recording)
    prepared = preparation is not None
    parts = _prepared(preparation, recording)
    logs = [_numbered(log_path, k, len(parts)) for k in range(1, len(parts) + 1)]
    earlier_remarks = {*recording.remarks, *summary.sentences}
    preparation_remarks = [
        [remark for remark in part.remarks if remark not in earlier_remarks] for part in parts
    ]
    for part, path, remarks in zip(parts, logs, preparation_remarks, strict=True):
        run_metadata = {
            "command": "trms import",
            "imported": "true",
            "file": str(arguments.file),
            "file_sha256": sha256,
        }
        if prepared:
            run_metadata["preparation"] = "; ".join(remarks)
        write_mcap(part, path, run_metadata, force=arguments.force)

    delays, loop = estimate_delays(recording), find_loop(recording)
    document = _document(recording, summary, delays, loop, arguments.file, logs, sha256)
    document["preparation"] = [
        {"log": str(path), "samples": len(part), "sample_time_s": part.sample_time, "done": remarks}
        for part, path, remarks in zip(parts, logs, preparation_remarks, strict=True)
        if prepared
    ]
    from trms_cli.library.tasks.admission import doubts

    document["notes"] += doubts(arguments.file)
    if arguments.json:
        print_json(document)
    else:
        _print(document)
    return 0


def _is_log(path: Path) -> bool:
    """Whether a file begins as an MCAP does; anything else is told by its reader."""
    try:
        with path.open("rb") as file:
            return file.read(5) == b"\x89MCAP"
    except OSError:
        return False


def _preparation(arguments: Any) -> Any:
    """The :class:`Preparation` asked for, or None."""
    from trms_cli.core.errors import ConfigurationError
    from trms_cli.core.plugins import build

    delays = {}
    for text in arguments.delay:
        name, _, seconds = text.partition("=")
        try:
            delays[name] = float(seconds)
        except ValueError:
            raise ConfigurationError(
                f"{text!r} given", where="--delay", remedy="NAME=SECONDS, as alpha_v=0.02"
            ) from None
    gaps: str | float = arguments.gaps
    if gaps not in ("keep", "split"):
        try:
            gaps = float(gaps)
        except ValueError:
            raise ConfigurationError(
                f"{arguments.gaps!r} given", where="--gaps", remedy="keep, split, or a time in s"
            ) from None
    if (
        arguments.outliers == "keep"
        and gaps == "keep"
        and arguments.resample is None
        and not delays
    ):
        return None
    node = {
        "_target_": "trms_cli.recordings.preparation.Preparation",
        "outliers": arguments.outliers,
        "gaps": gaps,
        "resample": arguments.resample,
        "delays": delays,
    }
    try:
        return build(node)
    except ConfigurationError as error:
        error.where = f"--{error.where}".replace("--delays", "--delay")
        raise


def _numbered(path: Path, number: int, of: int) -> Path:
    """``LOG.mcap``, or ``LOG-2.mcap`` of several."""
    return path if of == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")


def _prepared(preparation: Any, recording: Any) -> list[Any]:
    """The parts, with errors that name the options of this command."""
    from trms_cli.core.errors import RecordingError

    if preparation is None:
        return [recording]
    try:
        return list(preparation.apply(recording))
    except RecordingError as error:
        if error.where.split(".")[0] in ("delays", "gaps", "resample"):
            error.where = f"--{error.where}".replace("--delays.", "--delay ")
        raise


def _document(
    recording: Any,
    summary: Any,
    delays: list[Any],
    loop: Any,
    file: Path,
    logs: list[Path],
    sha256: str,
) -> dict[str, Any]:
    """Return the JSON twin of what is printed, in SI units."""
    channels = {}
    for name, channel in summary.channels.items():
        figures = asdict(channel)
        ends = {"min": figures.pop("minimum"), "max": figures.pop("maximum")}
        channels[name] = {"unit": recording.units[name], **ends, **figures}
    sentences = [
        *(*recording.notes(), *summary.sentences),
        *(delay.sentence() for delay in delays if delay.clear),
        loop.sentence(),
    ]
    table = [
        {
            "cause": delay.cause,
            "effect": delay.effect,
            "delay_s": delay.seconds,
            "deviation_s": delay.deviation,
            "explained": delay.explained,
            "clear": delay.clear,
        }
        for delay in delays
    ]
    return {
        "schema": "trms.import/1",
        "file": str(file),
        "sha256": sha256,
        "log": str(logs[0]),
        "logs": [str(path) for path in logs],
        "metadata": recording.metadata,
        "samples": len(recording),
        "start_s": float(recording.time[0]),
        "end_s": float(recording.time[-1]),
        "duration_s": recording.duration_s,
        "sample_time_s": recording.sample_time,
        "rate_hz": 1 / recording.sample_time,
        "gaps": [{"start_s": start, "end_s": end} for start, end in recording.gaps],
        "channels": channels,
        "delays": table,
        "loop": asdict(loop),
        "notes": sentences,
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
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 1, 0, 0))
    table.add_column("channel")
    table.add_column("unit")
    headings = ("min", "max", "quantum", "missing", "outliers", "limit %", "rest %", "turns")
    for heading in headings:
        table.add_column(heading, justify="right")
    for name, row in document["channels"].items():
        figures = (_figure(row[key]) for key in ("min", "max", "quantum"))
        counts = (str(row[key]) for key in ("missing", "outliers"))
        shares = (_percent(row[key]) for key in ("extreme_share", "rest_share"))
        turns = "–" if row["turns"] is None else str(row["turns"])
        table.add_row(name, row["unit"], *figures, *counts, *shares, turns)
    console.print(table)
    for note in document["notes"]:
        console.print(f"note: {escape(note)}")
    printed_remarks: set[str] = set()
    for part in document["preparation"]:
        for remark in part["done"]:
            if remark not in printed_remarks:
                console.print(f"done: {escape(remark)}")
                printed_remarks.add(remark)
        if len(document["logs"]) > 1:
            console.print(f"log: {escape(part['log'])} ({part['samples']} samples)")
    if len(document["logs"]) == 1:
        console.print(f"log: {escape(document['log'])}")


def _figure(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.2g}"
