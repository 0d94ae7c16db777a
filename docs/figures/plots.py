"""The figures of docs/plots.md and docs/foxglove.md, drawn by the program from runs of its own."""

from __future__ import annotations

import subprocess
from pathlib import Path

#: The runs that are drawn, by folder.
RUNS = {
    "newton_mpc": ["controller=newton_mpc"],
    "lqr": ["controller=lqr"],
    "pid": ["controller=pid"],
}
#: The figures: their runs and options.
FIGURES = {
    "plot_column.png": (["newton_mpc"], ["--width", "89mm", "--dpi", "200"]),
    "plot_three.png": (
        ["newton_mpc", "lqr", "pid"],
        ["--what", "tracking,inputs,comparison", "--dpi", "130"],
    ),
    "plot_estimate.png": (
        ["newton_mpc"],
        ["--what", "estimate,solver", "--from", "15", "--to", "30", "--dpi", "130"],
    ),
    "scene.png": (["newton_mpc"], ["--what", "scene", "--from", "20.5", "--dpi", "150"]),
    "scene.gif": (["newton_mpc"], ["--what", "scene", "--from", "19", "--to", "25"]),
}


def draw(folder: Path, program: str, scratch: Path) -> None:
    """Run what is drawn in `scratch`, and draw it into `folder`."""
    for name, words in RUNS.items():
        command = [program, "run", *words, "sim.duration=40", "picture=false", f"out={name}"]
        subprocess.run(command, cwd=scratch, check=True, capture_output=True)
    for name, (runs, options) in FIGURES.items():
        out = str((folder / name).resolve())
        command = [program, "plot", *runs, *options, "--out", out, "--force"]
        subprocess.run(command, cwd=scratch, check=True, capture_output=True)
