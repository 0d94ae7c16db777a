"""``trms blind score``: the key opened, diagnoses judged, the table printed and written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta

from trms_cli.composition.composer import Composition
from trms_cli.core.errors import EXIT_OK, ConfigurationError
from trms_cli.core.plugins import construct, nearest

if TYPE_CHECKING:
    from experiments.gap.blind.measures import Table
    from experiments.gap.blind.sealing import OpenedKey

DOCUMENT_NAME, PAGE_NAME = "score.json", "score.md"


@dataclass(frozen=True, kw_only=True)
class ScoreOptions:
    """The keys of ``configs/blind_score.yaml``."""

    source: str  #: Folder of the set (``in``)
    diagnoses: str | tuple[str, ...]  #: FOLDER or NAME=FOLDER
    key: str | None = None
    oracle: str | None = None  #: Name of the one that was told the effects
    fresh: bool = True  #: Whether models run on the second recordings
    bootstrap: Annotated[int, Meta(ge=100)] = 2000
    seed: Annotated[int, Meta(ge=0)] = 0
    jobs: Annotated[int, Meta(ge=1)] = 2
    out: str | None = None


def perform(composition: Composition) -> int:
    """Judge what a configuration asks for."""
    from experiments.gap.blind.make import key_folder_of
    from experiments.gap.blind.sealing import open_key
    from experiments.gap.blind.verdicts import markdown
    from trms_cli.core.whole_file import replace_whole
    from trms_cli.runs.run_folder import new_folder, removed_if_empty, write_document

    keys = dict(composition.config)
    options = construct(ScoreOptions, {"source": keys.pop("in"), **keys})
    source = Path(options.source).expanduser()
    methods = methods_of(options.diagnoses)
    if options.oracle is not None and options.oracle not in methods:
        raise ConfigurationError(
            f"none of the diagnoses is called {options.oracle!r}",
            where="oracle",
            remedy=nearest(options.oracle, methods),
        )
    # a folder that will not do is refused before minutes are spent
    folder = new_folder(options.out, "blind")
    with removed_if_empty(folder):
        key = open_key(key_folder_of(source, options.key), source)
        tables, document = _judged(options, key, methods)
        write_document(document, folder / DOCUMENT_NAME)
        replace_whole(folder / PAGE_NAME, markdown(document).encode())
    _print(tables, document, folder)
    return EXIT_OK


def _judged(
    options: ScoreOptions, key: OpenedKey, methods: Mapping[str, Path]
) -> tuple[dict[str, Table], dict[str, Any]]:
    """The table of each method, and all of it as a document."""
    from experiments.gap.blind.measures import table
    from experiments.gap.blind.verdicts import document_of, judge, with_fresh

    cases_by_method = {name: judge(key, folder) for name, folder in methods.items()}
    if options.fresh and key.fresh is not None:
        cases_by_method = {
            name: with_fresh(judged_cases, methods[name], key.fresh, options.jobs)
            for name, judged_cases in cases_by_method.items()
        }
    oracle = {j.name: j for j in cases_by_method[options.oracle]} if options.oracle else None
    tables = {
        name: table(judged_cases, oracle, draws=options.bootstrap, seed=options.seed)
        for name, judged_cases in cases_by_method.items()
    }
    return tables, document_of(key, tables, cases_by_method)


def methods_of(diagnoses: str | Sequence[str]) -> dict[str, Path]:
    """Folders of diagnoses by name; a folder without one is called by its own.

    Raises ConfigurationError if a folder does not exist, or two have one name.
    """
    folders: dict[str, Path] = {}
    for text in [diagnoses] if isinstance(diagnoses, str) else diagnoses:
        name, equals, place = text.partition("=")
        folder = Path(place if equals else text).expanduser()
        if not equals or "/" in name:
            folder = Path(text).expanduser()
            name = folder.name
        if not folder.is_dir():
            raise ConfigurationError(
                f"there is no folder {str(folder)!r}",
                where="diagnoses",
                remedy="diagnoses=FOLDER, or 'diagnoses=[NAME=FOLDER, NAME=FOLDER]'",
            )
        if name in folders:
            raise ConfigurationError(
                f"{name!r} is given twice", where="diagnoses", remedy="give each a name of its own"
            )
        folders[name] = folder
    return folders


def _print(tables: Mapping[str, Table], document: Mapping[str, Any], folder: Path) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table as Printed

    from experiments.gap.blind.verdicts import figure_text, reach

    console = Console()
    console.print(
        f"set {document['set']}, {document['cases']} rigs, seed {document['seed']}; the key is "
        f"the one that was told, {document['commitment'][:16]}…",
        highlight=False,
        soft_wrap=True,
    )
    for name, table in tables.items():
        method = document["methods"][name]
        printed = Printed(box=SIMPLE_HEAD, pad_edge=False)
        printed.add_column(name, header_style="bold cyan")
        for column in ("", "95 %", "cases", "reach"):
            printed.add_column(column, justify="right", no_wrap=True)
        for row in table.rows:
            e, style = row.estimate, {True: "green", False: "bold red", None: ""}[row.is_reached]
            interval = "" if e.low is None else f"{figure_text(e.low, row.unit)} … "
            interval += "" if e.high is None else figure_text(e.high, row.unit)
            cells = (
                figure_text(e.value, row.unit),
                interval,
                str(e.count),
                reach(row.target, row.unit),
            )
            printed.add_row(row.measure, *cells, style=style if e.count else "dim")
        console.print(printed)
        if method["diagnosed"] < document["cases"]:
            missing = document["cases"] - method["diagnosed"]
            console.print(f"  {missing} rigs are not diagnosed", style="yellow")
        reliability = table.reliability
        if reliability.calibration_error is not None:
            console.print(
                f"  calibration error {reliability.calibration_error:.3f}, "
                f"Brier {reliability.brier:.3f}"
                + ("" if table.seconds is None else f"; {table.seconds:.1f} s a diagnosis"),
                highlight=False,
            )
        console.print()
    written = f"written: {folder / DOCUMENT_NAME}, {folder / PAGE_NAME}"
    console.print(written, highlight=False, soft_wrap=True)
