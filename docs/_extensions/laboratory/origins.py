"""Under each page: which command made its tables and pictures, and at which revision."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from experiments.docs_check.sources import Source, read_sources, source_of
from experiments.provenance import Ledger, contents, read_ledger


@cache
def _known() -> tuple[dict[str, Source], Ledger]:
    return read_sources(), read_ledger()


def listing(name: str, docs: Path) -> str:
    """A table for the end of a page; empty where no command made anything of it."""
    page = docs / f"{name}.md"
    if not page.is_file() or "/" in name:
        return ""
    sources, ledger = _known()
    rows: dict[tuple[str, str], list[str]] = {}
    for key, value in contents(page, docs.parent).items():
        source = source_of(key, sources)
        if source is None:
            continue
        how = f"`{sources[source].command}`" if sources[source].command else "by hand"
        origin = ledger.get(key)
        made = "–"
        if origin is not None and origin.sha256 == value:
            by = "" if origin.evidence == "publication" else "committed as "
            made = f"{by}`{origin.revision}`, {origin.date}"
        what = key.partition("#")[2] or Path(key).name
        rows.setdefault((how, made), []).append(what)
    if not rows:
        return ""
    lines = [f"| {', '.join(what)} | {how} | {made} |" for (how, made), what in rows.items()]
    head = "\n\n## What made the tables and figures\n\n"
    head += "`make docs-check` makes them anew and tells what moved.\n\n"
    return head + "\n".join(
        ["| tables and figures | command | revision |", "|---|---|---|", *lines]
    )
