"""The figures on the page of the model are the model's."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.newtonian import Newtonian

PAGE = Path(__file__).parents[2] / "docs" / "model.md"
_ROW = re.compile(r"^\| (−?[\d.]+) \| (−?[\d.]+) \| (−?[\d.]+) \|$", re.MULTILINE)


def test_equilibria_of_the_page() -> None:
    model = Newtonian(freedom="vertical")
    step = BufferedFunction(discretise(model, 0.1, 10).step)
    rows = _ROW.findall(PAGE.read_text(encoding="utf-8"))
    assert len(rows) >= 8
    for row in rows:
        u_v, omega_v, alpha_v = (float(cell.replace("−", "-")) for cell in row)
        x = model.rest()
        for _ in range(2500):
            x = step.evaluate(x, [u_v], model.parameters.values, np.zeros(model.n_w))[0].ravel()
        found = dict(zip(model.state_names, x.tolist(), strict=True))
        assert found["omega_v"] == pytest.approx(omega_v, abs=0.06)
        assert found["alpha_v"] == pytest.approx(alpha_v, abs=6e-4)


def test_models_and_states_of_the_page() -> None:
    text = PAGE.read_text(encoding="utf-8")
    greek = {"omega": "ω", "alpha": "α", "S": "S", "i": "i"}
    for name, model in {
        "newtonian": Newtonian(),
        "newtonian_full": Newtonian(currents="dynamic"),
        "newtonian_vertical": Newtonian(freedom="vertical"),
        "newtonian_horizontal": Newtonian(freedom="horizontal"),
    }.items():
        states = ", ".join(f"{greek[s.split('_')[0]]}_{s[-1]}" for s in model.state_names)
        assert f"| `{name}` | {states} |" in text
