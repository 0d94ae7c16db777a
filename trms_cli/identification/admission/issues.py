"""What is wrong with recordings, and what to do about it."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Literal

from trms_cli.core.errors import RecordingError

Severity = Literal["error", "warning"]


@dataclass(frozen=True)
class Issue:
    """Something that is wrong with a recording, or not as good as it might be."""

    check: str  #: What was looked at, in one word or two
    severity: Severity  #: "error" or "warning"
    dataset: str  #: Name; empty for all together
    channel: str  #: Input or output; empty for the whole recording
    problem: str  #: A sentence
    remedy: str  #: What to record or to change instead

    def __str__(self) -> str:
        place = f"{self.dataset}: " if self.dataset else ""
        return f"{place}{self.problem} ({self.remedy})"


@dataclass(frozen=True)
class Admission:
    """What was found."""

    issues: tuple[Issue, ...]  #: Errors first

    @property
    def errors(self) -> tuple[Issue, ...]:
        return tuple(issue for issue in self.issues if issue.severity == "error")

    @property
    def warnings(self) -> tuple[Issue, ...]:
        return tuple(issue for issue in self.issues if issue.severity == "warning")

    def require(self) -> None:
        """Raise if there is an error.

        Raises RecordingError: Of the first error; the others are listed below its remedy.
        """
        errors = self.errors
        if not errors:
            return
        first, *others = errors
        remedy = "\n".join([first.remedy, *(f"also: {issue}" for issue in others)])
        raise RecordingError(first.problem, where=first.dataset or "real", remedy=remedy)

    def as_data(self) -> list[dict[str, str]]:
        """For a JSON document."""
        return [asdict(issue) for issue in self.issues]


def merge_admissions(admissions: Mapping[str, Admission]) -> Admission:
    """What was found with several models; what does not hold for all names those that it is of.

    ``admissions``: by the name that the model is shown with.
    """
    holders: dict[Issue, list[str]] = {}
    for name, admission in admissions.items():
        for issue in admission.issues:
            holders.setdefault(issue, []).append(name)
    return by_severity(
        issue
        if len(models) == len(admissions)
        else replace(issue, problem=f"{', '.join(models)}: {issue.problem}")
        for issue, models in holders.items()
    )


def by_severity(issues: Iterable[Issue]) -> Admission:
    """Errors first, each kind in its order."""
    return Admission(tuple(sorted(issues, key=lambda issue: issue.severity != "error")))
