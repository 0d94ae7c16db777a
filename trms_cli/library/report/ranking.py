"""The ranking of runs in a report: that of ``trms compare``, also over rows of the index."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from trms_cli.library.report.sweeps import keys_of, typed_of, value_of

if TYPE_CHECKING:
    from trms_cli.runs.query import QueryResult
    from trms_cli.scoring.comparison.ranking import Ranking
    from trms_cli.scoring.comparison.runs import ComparisonRun

#: Coordinates that every ranking looks at, also where runs do not differ in them.
_DRAW = "draw"
_RANKED = ("controller", "observer", "ref", "model", "plant", "seed")


def ranking_of(runs: Sequence[ComparisonRun]) -> Ranking | None:
    """The ranking that ``trms compare`` prints; None where nobody can be ranked."""
    from trms_cli.scoring.comparison.ranking import group, rank

    contest = group(runs)
    # Who differs from the others in draws or seeds alone is luckier, not better.
    if contest.by and set(contest.by) <= {_DRAW, "seed"}:
        return None
    ranking = rank(contest)
    return ranking if ranking.best else None


def compared(found: QueryResult, drawn: Sequence[str] = ()) -> list[ComparisonRun]:
    """Rows of the index as a ranking takes them, without reading a log again.

    All that was `drawn` for a run is one coordinate, its draw: a condition, and no entrant's.
    """
    from trms_cli.scoring.comparison.runs import ComparisonRun

    typed = [typed_of(row) for row in found.runs]
    keys = [key for key in keys_of(found.runs, typed) if key not in drawn]
    draws: dict[tuple[str, ...], str] = {}

    def coordinates(row: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, str]:
        told = {key: _coordinate(row, values, key) for key in (*_RANKED, *keys)}
        if drawn:
            place = tuple(str(values.get(key)) for key in drawn)
            told[_DRAW] = draws.setdefault(place, str(len(draws) + 1))
        return told

    return [
        ComparisonRun(
            path=str(row["path"]),
            coordinates=coordinates(row, values),
            state=_state(row),
            score=_score(row),
            message=str(row.get("problem") or ""),
        )
        for row, values in zip(found.runs, typed, strict=True)
    ]


def _coordinate(row: Mapping[str, Any], typed: Mapping[str, Any], key: str) -> str:
    value = value_of(row, typed, key)
    if value in (None, ""):
        return "none" if key in row or key in typed else "–"
    return str(value)


def _state(row: Mapping[str, Any]) -> Any:
    from trms_cli.scoring.comparison.runs import State

    if row.get("outcome") == "failed":
        return State.FAILED
    return State.DONE if row.get("complete") else State.INCOMPLETE


def _score(row: Mapping[str, Any]) -> dict[str, Any]:
    """The figures of a row in the shape of a score, as far as a ranking asks for them."""
    from trms_cli.scoring.figures import of_group

    def of(group: Any, name: str) -> dict[str, Any]:
        return {f.key: row.get(f"{f.column_name}_{name}") for f in of_group(group)}

    channels = {
        n: of("channels", n) for n in ("alpha_v", "alpha_h") if row.get(f"rmse_{n}") is not None
    }
    inputs = {n: of("inputs", n) for n in ("u_v", "u_h") if row.get(f"effort_{n}") is not None}
    return {
        "duration_s": row.get("duration"),
        "channels": channels,
        "inputs": inputs,
        "solver": {
            "time_ms": {key: row.get(f"solve_{key}") for key in ("median", "p99", "max")},
            "failures": row.get("failures"),
            "deadline_misses": row.get("deadline_misses"),
        },
    }
