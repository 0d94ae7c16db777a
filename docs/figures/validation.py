"""Figures of docs/validation.md: a simulated rig that differs, and models held against it."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from trms_cli.composition.composer import compose
from trms_cli.identification.validation import charts
from trms_cli.identification.validation.validate import validate_all
from trms_cli.library.tasks.validate import validation_of
from trms_cli.reporting.chart_picture import picture_of
from trms_cli.reporting.style import house_style, save_png

#: The rig of the page: two effects that `newtonian` does not know.
RIG = (
    *("controller=pid", "ref=multisine", "sim.duration=120", "seed=3", "picture=false"),
    "effect=[pitch_mass_imbalance,yaw_coulomb_friction]",
)


def draw(folder: Path) -> None:
    """Write ``validation_*.png`` into a folder."""
    with tempfile.TemporaryDirectory() as scratch:
        log = Path(scratch, "rig", "run.mcap")
        command = [sys.executable, "-m", "trms_cli", "run", *RIG, f"out={log.parent}"]
        subprocess.run(command, check=True, capture_output=True)
        composed = [
            compose([f"real={log}", *more], "validate")
            for more in ((), ("effect=[pitch_mass_imbalance,yaw_coulomb_friction]",))
        ]
        asked = [validation_of([composition], [name]) for composition, name in zip(
            composed, ("newtonian", "with both effects"), strict=True
        )]  # fmt: skip
        (nominal,), (right,) = (validate_all(a.models, a.datasets, a.options) for a in asked)
    both = [nominal, right]
    runs = charts.free_run_chart(both)
    drawn = {
        "free_runs": replace(runs, panels=runs.panels[:4]),
        "growth": charts.growth_chart(both),
        "regions": charts.region_chart([nominal]),
        "tests": charts.correlation_chart(nominal, ["alpha_v", "alpha_h"]),
    }
    with house_style():
        for name, chart in drawn.items():
            assert chart is not None
            save_png(picture_of(chart), folder / f"validation_{name}.png")


if __name__ == "__main__":
    draw(Path(__file__).parent)
