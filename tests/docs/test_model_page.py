"""The figures on the page of the model are the model's."""

import re
from pathlib import Path

import numpy as np
import pytest

from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.steady_state import SteadyState

from ..models.simulate import settle

PAGE = Path(__file__).parents[2] / "docs" / "model.md"
_ROW = re.compile(r"^\| (−?[\d.]+) \| (−?[\d.]+) \| (−?[\d.]+) \|$", re.MULTILINE)


def test_equilibria_of_the_page() -> None:
    rows = _ROW.findall(PAGE.read_text(encoding="utf-8"))
    assert len(rows) >= 8
    for row in rows:
        u_v, omega_v, alpha_v = (float(cell.replace("−", "-")) for cell in row)
        found = settle(Newtonian(freedom="vertical"), [u_v])
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


def test_the_reach_of_the_makers_model() -> None:
    text = PAGE.read_text(encoding="utf-8")
    (limit,) = re.findall(r"while the pitch stays below −([\d.]+) rad", text)
    steady = SteadyState(FeedbackManual())
    for pitch, reached in ((-float(limit) - 0.01, True), (-float(limit) + 0.01, False)):
        target = steady.solve(np.array([pitch, 0.0]))
        assert target.converged and target.projected is not reached
    # The tail rotor is what gives out.
    beyond = steady.solve(np.array([0.0, 0.0]))
    assert abs(beyond.u[1]) == pytest.approx(2.5, abs=1e-6) and beyond.u[0] < 2.0


def test_the_smoothed_sign_that_is_not_taken() -> None:
    c = {p.name: p.value for p in FeedbackManual().parameters}
    (pole,) = re.findall(r"\(−(\d+) 1/s for ε = 0.02 rad/s\)", PAGE.read_text(encoding="utf-8"))
    assert c["B_2phi"] / (c["I_2"] * 0.02) == pytest.approx(float(pole))
