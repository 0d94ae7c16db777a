"""From the name of a column, as it is typed, to the SQL that reads it."""

from __future__ import annotations

import difflib
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from trms_cli.runs.columns import ALIASES, COLUMNS, Column, figure_stems


@dataclass(frozen=True)
class Sql:
    """A part of a statement."""

    text: str  #: With ``?`` for each value
    values: tuple[Any, ...] = ()  #: To be bound, in their order


def column_sql(name: str, extra: Collection[str] | None = ()) -> tuple[Column, Sql] | None:
    """A column by any of its names, and the SQL that reads it; None if there is none.

    A name with a dot is a key that was typed: ``plant.prior_seed``.
    """
    name = ALIASES.get(name, name)
    if name in COLUMNS:
        return COLUMNS[name], Sql(f'"{name}"')
    renamed = name
    for said, ending in (("_yaw", "_alpha_h"), ("_pitch", "_alpha_v")):
        renamed = renamed.removesuffix(said) + ending if name.endswith(said) else renamed
    if _may_be_figure(renamed) if extra is None else renamed in extra:
        return Column(renamed, "number"), Sql("json_extract(more, ?)", (_json_path(renamed),))
    if "." in name:
        return Column(name, "any"), Sql("json_extract(typed, ?)", (_json_path(name),))
    return None


def nearest(name: str, extra: Collection[str] | None = ()) -> str:
    """What may have been meant, as a sentence."""
    known = [*COLUMNS, *ALIASES, *(extra or ())]
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.6)
    if close:
        return f"did you mean {' or '.join(close)}? all columns: trms runs --help"
    return "all columns: trms runs --help; a key that was typed has its dots: plant.prior_seed"


def _may_be_figure(name: str) -> bool:
    return any(name.startswith(f"{stem}_") for stem in figure_stems())


def _json_path(key: str) -> str:
    escaped = key.replace("\\", "\\\\").replace('"', '\\"')
    return f'$."{escaped}"'
