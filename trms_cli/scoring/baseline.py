"""Comparison of a score with an earlier one, within tolerances in physical units.

A figure is *worse* (or *better*) if it is larger (smaller) than the baseline's by more than its
tolerance, ``absolute + relative·|baseline|``. All figures compared here are better when small.
Only some are *judged*, i.e. decide whether a run got worse: those of tracking, of estimation, of
limits, and the solver's failures. Effort and iterations are shown for information; wall times
are left out, because they belong to the machine.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from trms_cli.core.data_file import read_json
from trms_cli.core.errors import RecordingError
from trms_cli.scoring import figures
from trms_cli.scoring import score as scoring
from trms_cli.scoring.figures import FigureTolerance

SCHEMA = "trms.baseline/1"

Verdict = Literal["better", "same", "worse", "new", "gone"]


@dataclass(frozen=True)
class Baseline:
    """A score to hold later ones against."""

    score: Mapping[str, Any]  #: A document ``trms.score/1``
    #: By key of a figure (``channels.alpha_v.rmse``) or by its last part (``rmse``); they replace
    #: those of :data:`~trms_cli.scoring.figures.FIGURES`
    tolerances: Mapping[str, FigureTolerance] = field(default_factory=dict)
    reason: str = ""  #: Why this score is the one to hold against

    def document(self) -> dict[str, Any]:
        """As JSON: ``trms.baseline/1``."""
        return {
            "schema": SCHEMA,
            "reason": self.reason,
            "tolerances": {key: asdict(value) for key, value in self.tolerances.items()},
            "score": dict(self.score),
        }


@dataclass(frozen=True)
class BaselineRow:
    """One figure, then and now."""

    key: str  #: Path in the score, e.g. ``channels.alpha_v.rmse``.
    baseline: float | None  #: None if it did not, or does not, exist
    now: float | None  #: None if it did not, or does not, exist
    tolerance: float  #: How far it may move, in ``unit``
    unit: str
    #: "better", "same" or "worse"; "new" if only this score has it, "gone" if only the baseline has
    #: it (judged, that is as bad as "worse": a step that settled no longer does)
    verdict: Verdict
    judged: bool  #: Whether it decides about the run

    @property
    def regressed(self) -> bool:
        """Whether this figure alone makes the run worse."""
        return self.judged and self.verdict in ("worse", "gone")


def compare(score: Mapping[str, Any], baseline: Baseline) -> list[BaselineRow]:
    """Every figure that this score or the baseline has, in the order of the score.

    Raises RecordingError if the two runs are of different length: sums over time would not compare.
    """
    length, before = float(score["duration_s"]), float(baseline.score["duration_s"])
    if abs(length - before) > 0.01 * max(length, before):
        raise RecordingError(
            f"the run is {length:g} s long, the baseline's {before:g} s",
            where=str(score.get("log", "")),
            remedy="compare runs of the same sim.duration, or write a new baseline",
        )
    now, then = _compared(score), _compared(baseline.score)
    keys = [*now, *(key for key in then if key not in now)]
    rows = []
    for key in keys:
        entry = now.get(key) or then[key]
        new, old = (side[key].value if key in side else None for side in (now, then))
        if new is None and old is None:
            continue
        own = baseline.tolerances
        figure_tolerance = own.get(key) or own.get(key.rpartition(".")[2]) or entry.figure.tolerance
        allowed = (
            figure_tolerance.limit(old) if figure_tolerance is not None and old is not None else 0.0
        )
        verdict = _verdict(new, old, allowed)
        rows.append(BaselineRow(key, old, new, allowed, entry.unit, verdict, entry.figure.judged))
    return rows


def has_regressed(rows: list[BaselineRow]) -> bool:
    """Whether any judged figure got worse."""
    return any(row.regressed for row in rows)


def read_baseline(path: Path) -> Baseline:
    """Read a baseline, or a score as ``trms score --json`` prints it, from a JSON file.

    Raises RecordingError if the file cannot be read or is neither.
    """
    try:
        document = read_json(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(
            f"the baseline cannot be read: {reason}",
            where=str(path),
            remedy="write one with: trms score LOG --write-baseline FILE",
        ) from error
    return baseline_from(document, str(path))


def baseline_from(document: Any, where: str) -> Baseline:
    """A baseline from its JSON document, which may also be a bare score.

    Raises RecordingError if it is neither.
    """
    schema = document.get("schema") if isinstance(document, dict) else None
    try:
        if schema == scoring.SCHEMA:
            return Baseline(_checked_score(document))
        if schema == SCHEMA:
            return Baseline(
                _checked_score(document["score"]),
                {key: _tolerance(entry) for key, entry in document["tolerances"].items()},
                str(document.get("reason", "")),
            )
        problem = f"its schema is {schema!r}"
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        problem = f"it is not complete ({type(error).__name__}: {error})"
    raise RecordingError(
        f"this is no baseline: {problem}",
        where=where,
        remedy=f"give a file of the schema {SCHEMA} or {scoring.SCHEMA}",
    )


def _checked_score(score: Any) -> dict[str, Any]:
    """The score, where it has all parts, and numbers in them."""
    float(score["duration_s"])
    for part in ("channels", "inputs", "constraint_violations"):
        for own in score[part].values():
            _check_numbers(own, [f.key for f in figures.of_group(part) if f.tolerance])
    for figure in figures.of_group("states"):
        _check_numbers(score["estimate"][figure.key], score["estimate"][figure.key])
    compared = [figure.key for figure in figures.of_group("solver") if figure.tolerance]
    _check_numbers({key: score["solver"][key] for key in compared}, compared)
    return dict(score)


def _check_numbers(owner: Mapping[str, Any], keys: Iterable[str]) -> None:
    for key in keys:
        if owner.get(key) is not None:
            float(owner[key])


def _tolerance(entry: Any) -> FigureTolerance:
    """A number is an absolute tolerance; otherwise a mapping with absolute and relative."""
    tolerance = (
        FigureTolerance(**entry) if isinstance(entry, dict) else FigureTolerance(absolute=entry)
    )
    for value in (tolerance.absolute, tolerance.relative):
        if not (math.isfinite(value) and value >= 0):
            raise ValueError(f"a tolerance of {value}")
    return tolerance


def _compared(score: Mapping[str, Any]) -> dict[str, figures.Entry]:
    """Everything in a score that can be compared, by its key."""
    return {
        entry.key: entry for entry in figures.entries(score) if entry.figure.tolerance is not None
    }


def _verdict(now: float | None, then: float | None, allowed: float) -> Verdict:
    if then is None:
        return "new"
    if now is None:
        return "gone"
    # rounding must not turn equality with the tolerance into a verdict
    slack = allowed + 1e-12 * (abs(now) + abs(then))
    if now > then + slack:
        return "worse"
    return "better" if now < then - slack else "same"


def document_of(
    scored: list[tuple[dict[str, Any], list[BaselineRow] | None]], baseline: Path | None
) -> dict[str, Any]:
    """One document: the score, or ``trms.scores/1`` with several of them."""
    documents = []
    for score, rows in scored:
        document = dict(score)
        if rows is not None:
            document["comparison"] = {
                "baseline": str(baseline),
                "worse": has_regressed(rows),
                "figures": [asdict(row) for row in rows],
            }
        documents.append(document)
    return documents[0] if len(documents) == 1 else {"schema": "trms.scores/1", "scores": documents}
