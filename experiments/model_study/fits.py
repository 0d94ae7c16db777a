"""Fits by ``trms identify``: every model is a file that ``model=FILE`` takes."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.model_study.study import Entrant
from trms_cli.core.errors import TrmsError


@dataclass(frozen=True)
class Fitted:
    """What an entrant brings: an option of ``model``, or a file."""

    model: str  #: What ``model=`` takes; empty where the fit ended in an error
    seconds: float = 0.0  #: That the fit took in one thread; 0 of a model as it is
    coefficients: int = 0  #: That were fitted
    problem: str = ""  #: The error's


def fit_all(
    entrants: Mapping[str, Entrant], words: Sequence[str], folder: Path
) -> dict[str, Fitted]:
    """Fit every entrant; those that need none bring their model as it is.

    ``words``: of ``trms identify``, on the recordings.
    """
    return {
        name: fit(entrant.fit, words, folder / name)
        if entrant.fit
        else Fitted(entrant.model or name)
        for name, entrant in entrants.items()
    }


def fit(own: Sequence[str], words: Sequence[str], folder: Path) -> Fitted:
    """Fit one model."""
    from trms_cli.composition.composer import compose
    from trms_cli.library.tasks import identify
    from trms_cli.library.tasks.task import Listener

    place = [f"out='{folder}'", "picture=false", "jobs=1"]
    try:
        with _silence():
            identify.perform(
                compose([*own, *words, *place], "identify"), Listener("identify"), None
            )
    except TrmsError as error:
        return Fitted("", problem=str(error).splitlines()[0])
    document = json.loads((folder / identify.DOCUMENT_NAME).read_text(encoding="utf-8"))
    return Fitted(
        str(folder / identify.MODEL_NAME),
        float(document["seconds"]["fit"]),
        _coefficients(document),
    )


def _coefficients(document: Mapping[str, object]) -> int:
    """How many numbers were fitted."""
    parameters = document["parameters"]
    assert isinstance(parameters, Mapping)
    if parameters:
        return len(parameters)
    details = document["details"]
    assert isinstance(details, Mapping)
    for key in ("parameters", "weights"):
        if isinstance(details.get(key), int):
            return int(details[key])
    return 0


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """What the commands say is said by the tables."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield
