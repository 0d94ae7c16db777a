"""The models that a recording leads to, made by the program's own commands.

Every model is a file that ``model=PATH`` takes, as a user would have it.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

#: Whose model the controller and the observer get.
NOMINAL, REFIT, DIAGNOSED = "nominal", "refit", "diagnosed"
KNOWN_CAUSE, TRUE = "known_cause", "true"
#: The refitted model with a network of torques.
NETWORK = "network"
NETWORK_WORDS = ("model=newtonian_with_network", "method=torque_network")
MODELS = (NOMINAL, REFIT, DIAGNOSED, KNOWN_CAUSE, TRUE)


def identify_model(recording: Path, out: Path, effect: str = "", words: Sequence[str] = ()) -> Path:
    """``trms identify`` on a recording: all parameters with priors, and the sizes of an effect.

    ``words``: more overrides. Returns the path of the fitted model; an earlier fit in the same
    folder is taken.
    """
    from trms_cli.composition.composer import compose
    from trms_cli.library.tasks import identify
    from trms_cli.library.tasks.task import Listener

    model = out / identify.MODEL_NAME
    if not model.exists():
        words = [f"real='{recording}'", f"out='{out}'", "picture=false", "jobs=1", *words]
        if effect:
            words += [f"effect={effect}", f"free=[priors,'{effect}.*']"]
        with _silence():
            identify.perform(compose(words, "identify"), Listener("identify"))
    return model


def diagnose_recordings(recordings: Sequence[Path], out: Path, words: Sequence[str] = ()) -> Path:
    """``trms diagnose`` on recordings.

    Returns the folder with ``diagnosis.json`` and ``corrected_model.yaml``; an earlier diagnosis is
    taken.
    """
    from trms_cli.commands import diagnose
    from trms_cli.composition.composer import compose

    if not (out / "corrected_model.yaml").exists():
        real = ",".join(f"'{path}'" for path in recordings)
        with _silence():
            diagnose.perform(compose([f"real=[{real}]", f"out='{out}'", *words], "diagnose"))
    return out


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """What the commands say is said by the tables."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield
