"""Equations as numbers: rates and slopes agree, motions are those of the equations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extended
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.models.vector_field import VectorField

MODEL = Newtonian()
FIELD = VectorField(MODEL)
U = np.array([1.0, 0.3])


def starts(count: int, seed: int = 0) -> np.ndarray:
    scale = np.array([80.0, 0.3, 0.5, 120.0, 0.3, 0.6])
    return scale * np.random.default_rng(seed).uniform(-1, 1, (count, 6))


def test_many_states_at_once_are_each_of_them():
    x = starts(7)
    assert FIELD.rates(x, U) == pytest.approx(np.array([FIELD.rates(row, U) for row in x]))


def test_slopes_are_those_of_the_rates():
    (x,) = starts(1)
    A, B = FIELD.linearised(x, U)
    for j, step in enumerate(1e-6 * np.maximum(np.abs(x), 1.0)):
        away = np.eye(6)[j] * step
        numeric = (FIELD.rates(x + away, U) - FIELD.rates(x - away, U)) / (2 * step)
        assert A[:, j] == pytest.approx(numeric, rel=1e-5, abs=1e-6)
    away = np.array([1e-6, 0.0])
    numeric = (FIELD.rates(x, U + away) - FIELD.rates(x, U - away)) / 2e-6
    assert B[:, 0] == pytest.approx(numeric, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("count", [1, 3])
def test_motions_are_those_of_another_integrator(count):
    x = starts(count)
    found = FIELD.motions(x, U, 5.0, 0.05)
    assert found.shape == (101, count, 6)
    for i, start in enumerate(x):
        known = solve_ivp(lambda t, z: FIELD.rates(z, U), (0, 5), start, rtol=1e-9, atol=1e-9)
        assert found[-1, i] == pytest.approx(known.y[:, -1], rel=1e-5, abs=1e-6)


def test_each_start_may_have_its_own_command():
    commands = np.array([[0.5, 0.0], [1.5, 0.2]])
    both = FIELD.motions(starts(2), commands, 2.0, 0.1)
    for i in range(2):
        alone = FIELD.motions(starts(2)[i], commands[i], 2.0, 0.1)
        assert both[:, i] == pytest.approx(alone[:, 0], abs=1e-12)


def test_dry_friction_holds_an_axis_unless_it_is_left_out():
    stuck = extended(MODEL, {"friction": CoulombFriction(axis="pitch", torque=0.05)})
    field = VectorField(stuck)
    start = operating_point(MODEL, {}).x.copy()
    start[MODEL.state_index("alpha_v")] += 0.1
    pitch = MODEL.state_index("alpha_v")
    held = field.motions(start, [0, 0], 2.0, 0.02)[:, 0, pitch]
    free = field.motions(start, [0, 0], 2.0, 0.02, impulses=False)[:, 0, pitch]
    assert np.ptp(held) < 1e-4 < 0.1 < np.ptp(free)
