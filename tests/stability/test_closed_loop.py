"""The loop around a rig from any state, its commands changed on the way."""

from __future__ import annotations

import numpy as np
import pytest
from loop_cases import MODEL, POINT, loop_of

from trms_cli.controllers.lqr import Lqr
from trms_cli.effects.extended_model import extended
from trms_cli.effects.rotor_reaction import RotorReaction
from trms_cli.stability.closed_loop import Enough, run_loop

LOOP = loop_of(Lqr())
PITCH = MODEL.state_index("alpha_v")


def test_at_its_point_the_loop_rests():
    run = run_loop(MODEL, LOOP, POINT, 2.0)
    assert run.time.shape == (100,) and run.x.shape == (100, 6) and run.u.shape == (100, 2)
    assert np.abs(run.x - POINT.x).max() < 1e-6 and not run.ended and not run.failures
    assert run.statuses == {"ok": 100}


def test_from_beside_it_comes_back():
    run = run_loop(MODEL, LOOP, POINT, 20.0, offset={"alpha_v": 0.1})
    assert run.x[0, PITCH] == pytest.approx(0.1, abs=1e-9)
    assert np.abs(run.x[-1] - POINT.x).max() < 0.01


def test_to_another_reference():
    run = run_loop(MODEL, LOOP, POINT, 20.0, reference={"alpha_v": 0.2})
    assert run.x[-1, PITCH] == pytest.approx(0.2, abs=0.01)


def test_what_reaches_the_motors_may_differ_from_the_command():
    run = run_loop(MODEL, LOOP, POINT, 1.0, path=lambda k, u: u + (0.1 if k == 10 else 0.0))
    assert run.applied[10] == pytest.approx(run.u[10] + 0.1)
    assert np.delete(run.applied, 10, 0) == pytest.approx(np.delete(run.u, 10, 0))
    assert np.abs(run.x[:11] - POINT.x).max() < 1e-6 < np.abs(run.x[12:] - POINT.x).max()


def test_the_rig_may_have_what_the_controller_does_not_know():
    rig = extended(MODEL, {"reaction": RotorReaction(rotor="main", drag=3e-7, inertia=1e-4)})
    known, other = (run_loop(model, LOOP, POINT, 20.0) for model in (MODEL, rig))
    assert np.abs(other.x - known.x).max() > 0.01


def test_two_runs_are_equal():
    first, second = (run_loop(MODEL, LOOP, POINT, 3.0, offset={"alpha_h": 0.1}) for _ in "ab")
    assert np.array_equal(first.x, second.x) and np.array_equal(first.u, second.u)


def test_a_run_may_end_at_a_state_or_when_its_path_has_enough():
    def enough(k, u):
        if k == 20:
            raise Enough("seen")
        return u

    by_path = run_loop(MODEL, LOOP, POINT, 2.0, path=enough)
    assert by_path.ended == "seen" and by_path.x.shape == (20, 6) and by_path.u.shape == (20, 2)
    at_once = run_loop(MODEL, LOOP, POINT, 2.0, until=lambda x: "here")
    assert at_once.ended == "here" and at_once.x.shape == (0, 6) and at_once.u.shape == (0, 2)
