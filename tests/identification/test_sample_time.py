"""Times in ms under a header that says s are refused before anything is simulated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trms_cli.core.errors import RecordingError
from trms_cli.identification.data import load_datasets
from trms_cli.models.newtonian import Newtonian


def recorded(folder: Path, step: float, unit: str = "s") -> str:
    t = step * np.arange(400)
    u = np.sign(np.sin(t))
    rows = "\n".join(f"{a:.6g},{b:g},0,{c:.4f}" for a, b, c in zip(t, u, 0.1 * u, strict=True))
    file = folder / "clock.csv"
    file.write_text(f"t[{unit}],u_v[V],u_h[V],alpha_v[rad]\n{rows}\n")
    return str(file)


def test_milliseconds_read_as_seconds_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="20 s a sample") as error:
        load_datasets(recorded(tmp_path, 20.0), Newtonian())
    assert "t[ms]" in str(error.value.remedy)


@pytest.mark.parametrize(("step", "unit"), [(20.0, "ms"), (0.02, "s"), (0.8, "s")])
def test_what_is_fast_enough_to_be_simulated_is_read(tmp_path, step, unit):
    (dataset,) = load_datasets(recorded(tmp_path, step, unit), Newtonian())
    assert len(dataset) == 400
