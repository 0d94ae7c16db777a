"""``python -m docs.figures``: everything in the pages that the program draws or prints itself.

Names of parts, ``python -m docs.figures run plots``, leave the others as they are.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from docs.figures import effect_gallery, first_look, plots, validation
from experiments import block_diagrams
from experiments.page_tables import write_tables

HERE = Path(__file__).parent
STARTED = HERE.parent / "getting-started.md"
#: Figures of docs/excitation.md, and how they are designed.
EXCITATIONS = {
    "excitation_multisine": [],
    "excitation_reversals": ["excitation=multilevel", "reversals=true"],
}


def main(argv: Sequence[str] | None = None) -> None:
    """Draw what the pages show; run `make run`'s run, keep its picture and what it printed."""
    parser = argparse.ArgumentParser(prog="python -m docs.figures", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; or all")
    arguments = parser.parse_args(argv)
    if unknown := set(arguments.parts) - PARTS.keys():
        parser.error(f"there is no part {sorted(unknown)[0]!r}: {', '.join(PARTS)}")
    for name in arguments.parts or PARTS:
        with tempfile.TemporaryDirectory() as scratch:
            PARTS[name](Path(scratch))


def _effects(scratch: Path) -> None:
    effect_gallery.main([str(HERE / "effects")])


def _validation(scratch: Path) -> None:
    validation.draw(HERE)


def _diagnosis(scratch: Path) -> None:
    block_diagrams.draw_diagnosis(HERE / "diagnosis.png")


#: Of the program's pages, whatever screen they are made at.
_SCREEN = {"TERM": "xterm", "COLUMNS": "100"}


def _run(scratch: Path) -> None:
    program, settings = _installed(scratch)
    command = [program, "run", "controller=newton_mpc", "ref=square"]
    subprocess.run([*command, "picture=false"], capture_output=True, **settings)
    shutil.rmtree(scratch / "outputs")  # the first one may have had to compile
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, encoding="utf-8", **settings)
    (picture,) = scratch.glob("outputs/*/*/run.png")
    shutil.copyfile(picture, HERE / "run.png")
    write_tables(STARTED, {"what make run prints": f"```text\n{done.stdout.rstrip()}\n```"})


def _excitation(scratch: Path) -> None:
    program, settings = _installed(scratch)
    for name, words in EXCITATIONS.items():
        designed = scratch / name
        subprocess.run(
            [program, "excite", *words, f"out={designed}"], capture_output=True, **settings
        )
        shutil.copyfile(designed / "excitation.png", HERE / f"{name}.png")


def _plots(scratch: Path) -> None:
    program, _ = _installed(scratch)
    plots.draw(HERE, program, scratch)


def _moving(scratch: Path) -> None:
    program, _ = _installed(scratch)
    first_look.draw_moving(HERE, program, scratch)


def _pages(scratch: Path) -> None:
    program, _ = _installed(scratch)
    first_look.draw_pages(HERE, program, scratch)


def _served(scratch: Path) -> None:
    program, _ = _installed(scratch)
    first_look.draw_served(HERE, program, scratch)


def _installed(scratch: Path) -> tuple[str, dict[str, Any]]:
    """The program, and how it is started: found on the path, it tells the next commands by its
    bare name."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    program = shutil.which("trms", path=path) or "trms"
    return program, {"cwd": scratch, "check": True, "env": os.environ | _SCREEN | {"PATH": path}}


PARTS: dict[str, Callable[[Path], None]] = {
    "effects": _effects,
    "validation": _validation,
    "diagnosis": _diagnosis,
    "run": _run,
    "excitation": _excitation,
    "plots": _plots,
    "moving": _moving,
    "pages": _pages,
    "served": _served,
}


if __name__ == "__main__":
    main()
