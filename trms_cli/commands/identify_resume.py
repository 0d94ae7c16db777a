"""``trms identify resume=FOLDER``: a search goes on where it was stopped."""

from __future__ import annotations

from pathlib import Path

from trms_cli.commands.identify_progress import STATE_NAME
from trms_cli.commands.resume import Resumption
from trms_cli.core.errors import ConfigurationError


def _has_state(folder: Path, text: str) -> None:
    if not (folder / STATE_NAME).is_file():
        raise ConfigurationError(
            f"{text!r} holds no state to go on from (no {STATE_NAME}): this fit was over before "
            "one was kept, or its method keeps none",
            where="resume",
            remedy="fit anew: such methods take seconds; or begin with model="
            f"{folder / 'model.yaml'}",
        )


RESUMPTION = Resumption(
    noun="fit",
    verb="fit",
    command="identify",
    may_change=("method.", "jobs=", "picture=", "--cfg", "job"),
    only="its budget (method.…), jobs and picture",
    check=_has_state,
)
