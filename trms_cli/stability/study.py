"""What a study is: a question about a model or a closed loop, and how it is answered."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from trms_cli.core.findings import Findings
from trms_cli.stability.subject import Subject

#: Told what is being done, in a few words; may be called as often as one likes.
Tell = Callable[[str], None]


@runtime_checkable
class Study(Protocol):
    """An immutable configuration with one method."""

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """The answer for a subject.

        Raises ModelError if the question makes no sense for this model, with what is possible.
        """
        ...


def silent(doing: str) -> None:
    """A :data:`Tell` that tells nobody."""
