"""Every observer over recordings of real rigs: only innovations can be told there."""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
from pathlib import Path
from typing import Any

from experiments.chapter7.observers.study import Study


def replay_all(study: Study, folder: Path) -> dict[str, dict[str, dict[str, Any]]]:
    """Innovation figures by recording, observer and channel; of the recordings that are there."""
    innovations = {}
    for name, recording in study.recordings.items():
        file = folder / recording.file
        if not file.is_file():
            continue
        innovations[name] = {
            observer: _replay(
                [
                    *(f"plant.file='{file}'", *recording.run, f"observer={observer}"),
                    *recording.observers.get(observer, []),
                ]
            )
            for observer in study.observers
        }
    return innovations


def _replay(overrides: list[str]) -> dict[str, Any]:
    """The channels of ``innovations.json`` of a run of ``trms run plant=replay``."""
    from trms_cli.commands import run
    from trms_cli.composition.composer import compose
    from trms_cli.library.tasks.replay import INNOVATIONS_NAME

    with tempfile.TemporaryDirectory(prefix="trms-observers-") as scratch, _silence():
        out = Path(scratch) / "run"
        run.perform(compose(["plant=replay", *overrides, "picture=false", f"out='{out}'"]))
        document = json.loads((out / INNOVATIONS_NAME).read_text(encoding="utf-8"))
    channels: dict[str, Any] = document["channels"]
    return channels


@contextlib.contextmanager
def _silence() -> Any:
    """What the runs say is said by the tables."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield
