"""What a sampler has to say at the end of a sweep: tables, pictures, and what to type next."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trms_cli.core.invocation import program

#: What runs are given because they are many.
_OF_SWEEPS = ("picture", "sim.scene_every")
_NAMES = {
    "optimisation": ("pareto.png", "search.png"),
    "robustness": ("robustness.png", "sensitivity.png"),
}


def draw(folder: Path, summary: Mapping[str, Any]) -> list[Path]:
    """Pictures of a sweep that has ended, into its folder; none of what has nothing to show.

    Parameters
    ----------
    folder : Path
    summary : dict
        What the sampler said (``summary`` of ``sweep.json``).
    """
    kind = summary.get("kind")
    if kind == "optimisation" and len(summary["trials"]) > 1:
        from trms_cli.reporting.search_picture import draw_pareto, draw_search

        if len(summary["objectives"]) > 1 and draw_pareto(summary, folder / "pareto.png"):
            return [folder / "pareto.png"]
        if len(summary["objectives"]) == 1 and draw_search(summary, folder / "search.png"):
            return [folder / "search.png"]
    if kind == "robustness":
        from trms_cli.reporting.robustness_picture import draw_robustness, draw_sensitivity

        drawn = [
            folder / name
            for name, picture in (
                ("robustness.png", draw_robustness),
                ("sensitivity.png", draw_sensitivity),
            )
            if picture(summary, folder / name)
        ]
        return drawn
    return []


def say(document: Mapping[str, Any]) -> None:
    """Print what a sampler said.

    Parameters
    ----------
    document : dict
        ``trms.sweep-status/1``.
    """
    summary = document["summary"]
    kind = summary.get("kind")
    if kind == "optimisation":
        from trms_cli.commands.sweep_search_screen import say_search

        say_search(summary)
        _say_command(document)
    elif kind == "robustness":
        from trms_cli.commands.sweep_robustness_screen import say_robustness

        say_robustness(summary)
    else:
        return
    for name in _NAMES[kind]:
        if (Path(document["folder"]) / name).is_file():
            print(f"picture    {Path(document['folder']) / name}")


def _say_command(document: Mapping[str, Any]) -> None:
    """How to run the best by itself."""
    from trms_cli.commands.sweep_search_screen import chosen_trial

    chosen = chosen_trial(document["summary"])
    if chosen is None or not chosen["overrides"]:
        return
    fixed = [w for w in document["summary"]["fixed"] if w.partition("=")[0] not in _OF_SWEEPS]
    words = [*fixed, *chosen["overrides"]]
    print(f"trial {chosen['trial']} alone")
    print(f"  {program()} {document['primary']} {shlex.join(words)}")
