"""Figures of docs/validation.md: a simulated rig that differs, and models held against it."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from trms_cli.commands.validate_pictures import correlation_rows, error_growths, free_run_traces
from trms_cli.commands.validate_request import validation_of
from trms_cli.composition.composer import compose
from trms_cli.identification.validation.validate import validate_all
from trms_cli.reporting.style import save_png
from trms_cli.reporting.validation_figures import free_run_figure, growth_figure, region_figure
from trms_cli.reporting.validation_spectra import correlation_figure

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
    units = {s.name: s.unit for s in (*nominal.model.inputs, *nominal.model.outputs)}
    _, traces = free_run_traces([nominal, right])
    save_png(free_run_figure(traces[:2]), folder / "validation_free_runs.png")
    save_png(growth_figure(error_growths([nominal, right])), folder / "validation_growth.png")
    save_png(
        region_figure({nominal.name: nominal.regions}, units, nominal.region_horizon),
        folder / "validation_regions.png",
    )
    rows = {
        channel: row for channel, row in correlation_rows(nominal).items() if "alpha" in channel
    }
    save_png(correlation_figure(rows), folder / "validation_tests.png")


if __name__ == "__main__":
    draw(Path(__file__).parent)
