"""Further ends of the Newton MPC's horizon: dual mode, control Lyapunov, contractive."""

from typing import Any

import numpy as np
import pytest

from trms_cli.code_generation.export import check_exportable
from trms_cli.controllers.controller import Status
from trms_cli.controllers.newton.state import NewtonMpcState
from trms_cli.controllers.newton.terminals import LOCAL_LAW, STATES
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.newtonian import Newtonian

from .closed_loop_case import close_loop, constant, sample_of, setup_of, state_with

MODEL = Newtonian()
SHORT: dict[str, Any] = {"prediction_horizon": 15, "move_blocks": (1, 1, 1, 2, 2, 4, 4)}
GOAL = (0.2, 0.5)


class Kept:
    """A law whose states at each sample can be looked at."""

    def __init__(self, law: NewtonMpc) -> None:
        self.law, self.seen = law, []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.law, name)

    def init(self, setup: Any) -> Any:
        self.state: Any = self.law.init(setup)
        return self.state

    def step(self, state: Any, sample: Any, **more: Any) -> Any:
        command = state.step(sample, **more)
        self.seen.append(self.look(state))
        return command

    def look(self, state: Any) -> tuple[float, float, float]:
        """√V (or the contractive distance) now and at the horizon's end, and what it may be."""
        at = state.newton.horizon.arguments
        root, centre = at["root"], at["centre"].ravel()
        now = np.concatenate([state._full, state._last_command]) - centre
        end = np.concatenate([state.newton.trajectory[:, -1], state.newton.plan[:, -1]]) - centre
        return (
            float(np.linalg.norm(root @ now)),
            float(np.linalg.norm(root @ end)),
            float(at["radius"].item()),
        )


@pytest.mark.parametrize("terminal", STATES)
def test_the_loop_comes_to_its_reference_and_the_prediction_ends_where_it_must(
    terminal: Any,
) -> None:
    law = Kept(NewtonMpc(terminal=terminal, **SHORT))
    ran = close_loop(law, MODEL, constant(*GOAL), 20.0)
    np.testing.assert_allclose(ran.errors[-1], 0.0, atol=2e-3)
    kept = [
        (end, radius)
        for (_, end, radius), command in zip(law.seen, ran.commands, strict=True)
        if command.status is Status.OK
    ]
    assert len(kept) > 0.6 * len(ran.commands)
    for end, radius in kept:
        assert end <= radius * (1.0 + 1e-6) + 1.1e-3


def test_the_contraction_is_that_of_the_present_distance() -> None:
    for share in (0.9, 0.4):
        law = Kept(NewtonMpc(terminal="contractive", contraction=share, **SHORT))
        close_loop(law, MODEL, constant(*GOAL), 1.0)
        for now, _, radius in law.seen:
            assert radius == pytest.approx(share * now, rel=1e-9)


def test_a_contraction_that_cannot_be_is_relaxed_and_said() -> None:
    law = NewtonMpc(terminal="contractive", contraction=0.01, **SHORT)
    command = law.step(law.init(setup_of(MODEL)), sample_of(MODEL, GOAL), want_prediction=False)
    assert command.status is Status.RELAXED
    assert command.terminal_residual > 1e-3


def test_a_target_without_a_region_has_a_contraction() -> None:
    """A tail rotor that stands still: the other two end in the steady state there."""
    for terminal, words in (("contractive", False), ("dual_mode", True)):
        law = NewtonMpc(terminal=terminal, **SHORT)
        ran = close_loop(
            law, Newtonian(parameters={"k_chn": 0.0, "k_chp": 0.0}), constant(0.1, 0.3), 1.0
        )
        assert ("no terminal region" in ran.commands[-1].message) is words


def test_inside_of_the_region_the_local_law_acts_and_v_falls() -> None:
    law = Kept(NewtonMpc(terminal="dual_mode", **SHORT))
    ran = close_loop(law, MODEL, constant(*GOAL), 20.0)
    inside = [command.message == LOCAL_LAW for command in ran.commands]
    assert not inside[0] and inside[-1]
    first = inside.index(True)
    assert all(inside[first:])  # it is invariant
    region, values = law.state.region, [now**2 for now, _, _ in law.seen[first:]]
    assert values[0] <= region.level
    falls = np.diff(values)
    assert np.all((falls < 0.0) | (np.array(values[1:]) < 1e-12))
    deviation = law.state.deviation
    u_s = law.state.target.u
    np.testing.assert_allclose(ran.inputs[-1], u_s + region.gain @ deviation, atol=1e-12)
    assert all(command.iterations == 0 for command in ran.commands[first:])


def test_outside_of_the_region_dual_mode_is_the_quasi_infinite_horizon() -> None:
    x = state_with(MODEL, alpha_v=-0.3)
    states: list[Any] = [
        NewtonMpcState(law, setup_of(MODEL))
        if law.terminal == "quasi_infinite"
        else law.init(setup_of(MODEL))
        for law in (NewtonMpc(terminal=t, **SHORT) for t in ("dual_mode", "quasi_infinite"))
    ]
    first = [state.step(sample_of(MODEL, GOAL, x), want_prediction=False).u for state in states]
    np.testing.assert_allclose(*first, atol=1e-12)


def test_the_local_law_does_not_follow_a_reference_that_moves() -> None:
    law = NewtonMpc(terminal="dual_mode", preview_horizon=15, **SHORT)
    ran = close_loop(law, MODEL, lambda t: np.outer(np.sin(0.3 * t), GOAL), 3.0)
    assert not any(command.message == LOCAL_LAW for command in ran.commands)


def test_the_end_is_no_higher_than_that_of_the_law_alone_or_of_the_present() -> None:
    law = Kept(NewtonMpc(terminal="control_lyapunov", **SHORT))
    ran = close_loop(law, MODEL, constant(*GOAL), 6.0)
    for now, _, radius in law.seen:
        assert radius <= now * (1.0 + 1e-12)
    # Where the law alone does worse than staying, the present level is what binds, else the law's.
    assert min(radius / now for now, _, radius in law.seen) < 0.9
    assert all(command.status in (Status.OK, Status.BUDGET) for command in ran.commands)


@pytest.mark.parametrize("terminal", STATES)
def test_it_has_no_c(terminal: Any) -> None:
    with pytest.raises(ConfigurationError, match="no C source") as caught:
        check_exportable(NewtonMpc(terminal=terminal))
    assert caught.value.where == "controller.terminal"
