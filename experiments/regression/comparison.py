"""The recorded baseline of the matrix, and what differs from it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import date
from pathlib import Path
from typing import Any, Literal

from experiments.regression.matrix import HERE, Case
from experiments.regression.runs import Outcome
from trms_cli.core.errors import RecordingError
from trms_cli.scoring.baseline import Baseline, BaselineRow, baseline_from, compare, has_regressed

SCHEMA = "trms.regression_baseline/1"
BASELINE = HERE / "baseline.json"
_REMEDY = 'record one with: make regression-update REASON="why"'
#: Significant digits that are kept: far below every tolerance, and a diff that can be read.
_DIGITS = 6

RunVerdict = Literal["same", "better", "worse", "failed", "new"]


@dataclass
class BaselineFile:
    """A baseline file."""

    #: ``reason``, ``date``, ``git``: Why, when (ISO 8601) and at which revision it was recorded
    reason: str = ""
    date: str = ""
    git: str = ""
    #: By name of the case: ``overrides`` and ``score``
    runs: dict[str, dict[str, Any]] = field(default_factory=dict)
    #: Reason, date and git of those before it, newest first
    history: list[dict[str, str]] = field(default_factory=list)

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return {"schema": SCHEMA, **asdict(self)}


@dataclass(frozen=True)
class Comparison:
    """A case beside its baseline."""

    outcome: Outcome
    #: Every figure that is held; empty if the run failed or there is no baseline for it
    rows: list[BaselineRow]
    #: "worse" if a figure got worse, "failed" if the run did, "new" if the baseline lacks it
    verdict: RunVerdict

    @property
    def bad(self) -> bool:
        """Whether this fails the regression."""
        return self.verdict in ("worse", "failed", "new")


def read_recorded(path: Path = BASELINE) -> BaselineFile:
    """Read a baseline file.

    Raises RecordingError if it is missing or not complete.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise RecordingError("there is no baseline", where=str(path), remedy=_REMEDY) from error
    except (OSError, ValueError) as error:
        raise RecordingError(
            f"the baseline cannot be read: {error}",
            where=str(path),
            remedy=f"restore it with git, or {_REMEDY}",
        ) from error
    try:
        if document["schema"] != SCHEMA:
            raise KeyError(f"schema {document['schema']!r}")
        for run in document["runs"].values():
            baseline_from(run["score"], str(path))
            list(map(str.strip, run["overrides"]))
        return BaselineFile(**{key: value for key, value in document.items() if key != "schema"})
    except (KeyError, TypeError, AttributeError, RecordingError) as error:
        raise RecordingError(
            f"this is no baseline of the matrix: {error}",
            where=str(path),
            remedy=f"restore it with git, or {_REMEDY}",
        ) from error


def check_matrix(cases: Sequence[Case], recorded: BaselineFile) -> None:
    """Refuse to compare a run with another run's score.

    Raises RecordingError if a case has other overrides than the baseline's of its name.
    """
    for case in cases:
        run = recorded.runs.get(case.name)
        if run is not None and tuple(run["overrides"]) != case.overrides:
            raise RecordingError(
                f"the baseline of {case.name} is of another run: {' '.join(run['overrides'])}",
                where="matrix.yaml",
                remedy=_REMEDY,
            )


def compare_outcome(outcome: Outcome, recorded: BaselineFile) -> Comparison:
    """Hold one outcome against the baseline."""
    if outcome.score is None:
        return Comparison(outcome, [], "failed")
    if outcome.case.name not in recorded.runs:
        return Comparison(outcome, [], "new")
    then = recorded.runs[outcome.case.name]["score"]
    now = baseline_part(outcome.score, outcome.case)
    rows = compare(now, Baseline(then, outcome.case.tolerances))
    if has_regressed(rows):
        return Comparison(outcome, rows, "worse")
    better = any(row.verdict == "better" and row.judged for row in rows)
    return Comparison(outcome, rows, "better" if better else "same")


def baseline_part(score: Mapping[str, Any], case: Case) -> dict[str, Any]:
    """The part of a score that a case is held to, rounded: what stands in the baseline."""
    case_tolerances = case.tolerances

    def part(group: str, values: Mapping[str, Any]) -> dict[str, Any]:
        return {
            name: _rounded(value)
            for name, value in values.items()
            if name == "unit" or name in case_tolerances or f"{group}.{name}" in case_tolerances
        }

    return {
        "schema": score["schema"],
        "log": "",
        "complete": score["complete"],
        "duration_s": score["duration_s"],
        "channels": {n: part(f"channels.{n}", v) for n, v in score["channels"].items()},
        "inputs": {n: part(f"inputs.{n}", v) for n, v in score["inputs"].items()},
        "estimate": {
            kind: {
                name: _rounded(value)
                for name, value in score["estimate"][kind].items()
                if f"estimate.{kind}.{name}" in case_tolerances
            }
            for kind in ("rmse", "prediction_rmse")
        },
        "solver": {"iterations_mean": None, "failures": None} | part("solver", score["solver"]),
        "constraint_violations": {
            n: part(f"constraint_violations.{n}", v)
            for n, v in score["constraint_violations"].items()
        },
    }


def _rounded(value: Any) -> Any:
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value


def write_recorded(
    outcomes: Sequence[Outcome], before: BaselineFile, reason: str, git: str, path: Path = BASELINE
) -> BaselineFile:
    """Make the scores of these outcomes the baseline.

    Raises RecordingError if a run failed, or the file cannot be written: the old one stays.
    """
    from trms_cli.core.whole_file import whole_file

    for outcome in outcomes:
        if outcome.score is None:
            raise RecordingError(
                f"{outcome.case.name} failed: {outcome.problem}",
                where=str(path),
                remedy="a baseline is recorded of whole runs only; the old one stays",
            )
    history = list(before.history)
    if before.reason:
        history.insert(0, {"reason": before.reason, "date": before.date, "git": before.git})
    new = BaselineFile(
        reason,
        date.today().isoformat(),
        git,
        {
            outcome.case.name: {
                "overrides": list(outcome.case.overrides),
                "score": baseline_part(outcome.score or {}, outcome.case),
            }
            for outcome in outcomes
        },
        history,
    )
    text = json.dumps(new.document(), indent=1, ensure_ascii=False, allow_nan=False)
    with whole_file(path, force=True) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    return new
