"""What ``trms rig drive`` adds to what was typed: the exported controller, its observer, its model.

The rest is ``trms run``, so that a rig is connected, checked, armed, driven, landed and scored as
under any other law.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from trms_cli.code_generation.exported import ExportFolder, read_export
from trms_cli.composition.overrides import quote_value
from trms_cli.core.trust import allow_export

#: Replaces the simulated rig of ``trms run``.
_PLANT = "plant=udp"


def run_words(folder: Path, typed: Sequence[str]) -> list[str]:
    """The words of ``trms run`` with which a folder's controller drives; it may be compiled then.

    What is typed comes last, and so counts. Raises ConfigurationError for a folder that holds no
    export.
    """
    export = read_export(folder.expanduser().resolve())
    allow_export(export.path)
    is_given = {word.lstrip("+").partition("=")[0] for word in typed}
    return [*_words(export, is_given), *typed]


def _words(export: ExportFolder, is_given: set[str]) -> list[str]:
    words = ["controller=exported", f"controller.folder={quote_value(str(export.path))}"]
    again = bool({"--from", "experiment"} & is_given)  # rig and model come with it
    if "plant" not in is_given and not again:
        words.insert(0, _PLANT)
    if "controller.delay" not in is_given:  # the loop's part of the law, which no C holds
        words += [word for word in export.overrides if word.startswith("controller.delay=")]
    if "observer" not in is_given and export.observer_period is not None:
        words.append("observer=exported")
        if "sim.sample_time" not in is_given:
            words.append(f"sim.sample_time={export.observer_period:g}")
    if not again and not any(key.partition(".")[0] == "model" for key in is_given):
        words += [w for w in export.overrides if w.partition("=")[0].partition(".")[0] == "model"]
    return words
