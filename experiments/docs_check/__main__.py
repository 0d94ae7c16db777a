"""``python -m experiments.docs_check``: what made the pages' tables and pictures, and again.

Lists each with its command, the revision that it was made at and its age; makes them anew in a
copy of the checkout, compares, and ends with 1 when one moved beyond its tolerance.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from datetime import UTC, date, datetime
from pathlib import Path

from experiments.command_line import exit_code_of, one_thread_each
from experiments.docs_check.anew import Outcome, make_anew
from experiments.docs_check.sources import Source, made_by, read_sources, source_of
from experiments.provenance import (
    ROOT,
    Ledger,
    complete,
    contents,
    contents_of_all,
    pages_of,
    read_ledger,
    write_ledger,
)
from trms_cli.core.errors import EXIT_OK, EXIT_WORSE, ConfigurationError
from trms_cli.core.plugins import nearest


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 1 when a table or picture is not what it was."""
    arguments = _parser().parse_args(argv)
    one_thread_each()
    return exit_code_of(lambda: _check(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m experiments.docs_check",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", metavar="PAGE", help="one page: chapter5, docs/chapter5.md")
    parser.add_argument("--source", metavar="NAME", help="one source of sources.yaml")
    parser.add_argument("--cheap", action="store_true", help="those that take seconds, as CI does")
    parser.add_argument("--list", action="store_true", help="tell what made them, make nothing")
    parser.add_argument(
        "--record", action="store_true", help="put down by git what no publication put down"
    )
    parser.add_argument("--records", type=Path, help="folder with recordings in tras/ and aero/")
    return parser


def _check(arguments: argparse.Namespace) -> int:
    sources = read_sources()
    keys = _chosen_keys(arguments.only)
    if arguments.source is not None and arguments.source not in sources:
        raise ConfigurationError(
            f"no source is called {arguments.source!r}",
            where="--source",
            remedy=nearest(arguments.source, list(sources)),
        )
    if arguments.record:
        write_ledger(complete(read_ledger()))
    work = {
        name: (source, made_by(name, sources, keys))
        for name, source in sources.items()
        if arguments.source in (None, name) and (source.cheap or not arguments.cheap)
    }
    chosen = [key for _, its_keys in work.values() for key in its_keys]
    unknown = [key for key in keys if source_of(key, sources) is None]
    _list(sources, chosen, complete(read_ledger()))
    for key in unknown:
        sys.stdout.write(
            f"{key}: no source makes it; add it to experiments/docs_check/sources.yaml\n"
        )
    if arguments.list or arguments.record:
        return EXIT_WORSE if unknown else EXIT_OK
    outcomes = _make(work, arguments.records)
    return EXIT_WORSE if unknown or _tell(outcomes) else EXIT_OK


def _chosen_keys(only: str | None) -> list[str]:
    """Tables and pictures: of all pages, or of one."""
    pages = pages_of()
    if only is None:
        return list(contents_of_all())
    for page in pages:
        name = page.relative_to(ROOT).as_posix()
        if only in (name, page.name, page.stem):
            return [*contents(page)]
    raise ConfigurationError(
        f"no page is called {only!r}",
        where="--only",
        remedy=nearest(only, [page.stem for page in pages]),
    )


def _list(sources: Mapping[str, Source], keys: Sequence[str], origins: Ledger) -> None:
    today = datetime.now(UTC).date()
    for name, source in sources.items():
        its = made_by(name, sources, keys)
        if not its:
            continue
        how = source.command or f"by hand: {source.by_hand}"
        took = f" ({source.seconds:.0f} s)" if source.seconds else ""
        sys.stdout.write(f"\n{name}: {how}{took}\n")
        for key in its:
            origin = origins.get(key)
            if origin is None:
                words = "not committed as it is, and not put down"
            else:
                days = (today - date.fromisoformat(origin.date)).days
                by = "made at" if origin.evidence == "publication" else "committed as"
                words = f"{by} {origin.revision}, {origin.date}, {days} d"
            sys.stdout.write(f"  {key:<58} {words}\n")
    sys.stdout.write("\n")
    sys.stdout.flush()


def _make(work: Mapping[str, tuple[Source, Sequence[str]]], records: Path | None) -> list[Outcome]:
    outcomes = []
    with tempfile.TemporaryDirectory(prefix="trms-docs-") as scratch:
        for name, (source, keys) in work.items():
            if not keys or source.by_hand:
                continue
            outcome = make_anew(name, source, keys, Path(scratch), records)
            outcomes.append(outcome)
            words = outcome.problem or f"{outcome.compared} compared, {len(outcome.changes)} moved"
            sys.stdout.write(f"{outcome.seconds:7.1f} s  {name}: {words}\n")
            sys.stdout.flush()
    return outcomes


def _tell(outcomes: Sequence[Outcome]) -> bool:
    """Name all that moved and all that could not be made; whether there is any."""
    moved = [change for outcome in outcomes for change in outcome.changes]
    for change in moved:
        sys.stdout.write(f"  {change}\n")
    failed = [outcome for outcome in outcomes if outcome.problem]
    for outcome in failed:
        sys.stdout.write(f"  {outcome.name}: {outcome.problem}\n")
    sys.stdout.write(
        f"{sum(outcome.compared for outcome in outcomes)} tables and pictures compared, "
        f"{len(moved)} moved beyond their tolerance; {len(failed)} sources not made\n"
    )
    return bool(moved or failed)


if __name__ == "__main__":
    sys.exit(main())
