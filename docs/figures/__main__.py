"""``python -m docs.figures``: everything in the pages that the program draws or prints itself."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from docs.figures import effect_gallery, plots, validation
from experiments import block_diagrams

HERE = Path(__file__).parent
README = HERE.parents[1] / "README.md"
BEGIN, END = "<!-- what make run prints: begin -->", "<!-- what make run prints: end -->"
#: Figures of docs/excitation.md, and how they are designed.
EXCITATIONS = {
    "excitation_multisine": [],
    "excitation_reversals": ["excitation=multilevel", "reversals=true"],
}


def main() -> None:
    """Draw what the pages show; run the README's run, keep its picture and what it printed."""
    effect_gallery.main([str(HERE / "effects")])
    validation.draw(HERE)
    block_diagrams.draw_diagnosis(HERE / "diagnosis.png")
    with tempfile.TemporaryDirectory() as scratch:
        # found on the path, the program tells the next commands by its bare name
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        told = {"cwd": scratch, "check": True, "env": os.environ | {"PATH": path}}
        command = [shutil.which("trms", path=path) or "trms", "run"]
        command += ["controller=newton_mpc", "ref=square"]
        subprocess.run([*command, "picture=false"], capture_output=True, **told)
        shutil.rmtree(Path(scratch, "outputs"))  # the first one may have had to compile
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, encoding="utf-8", **told)
        (picture,) = Path(scratch).glob("outputs/*/*/run.png")
        shutil.copyfile(picture, HERE / "run.png")
        for name, words in EXCITATIONS.items():
            designed = Path(scratch, name)
            subprocess.run(
                [command[0], "excite", *words, f"out={designed}"], capture_output=True, **told
            )
            shutil.copyfile(designed / "excitation.png", HERE / f"{name}.png")
        plots.draw(HERE, command[0], Path(scratch))
    before, _, rest = README.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise SystemExit(f"{README} has lost its marks {BEGIN} … {END}")
    printed = f"{BEGIN}\n```text\n{done.stdout.rstrip()}\n```\n{END}"
    README.write_text(f"{before}{printed}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
