"""Experiments from the program's own configuration, and closed loops kept in memory."""

from __future__ import annotations

import json
from typing import Any

from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.simulation.closed_loop import Experiment, Loop

#: Squares of ±0.3 rad pitch and ±0.5 rad yaw at 0.025 Hz: the benchmark of the project, on both
#: axes at once and on each alone. The axis alone leaves the other one at the constant zero.
SQUARES = {
    "both": ("ref=square",),
    "pitch": ("ref=square", "ref.alpha_h.amplitude=0"),
    "yaw": ("ref=square", "ref.alpha_v.amplitude=0"),
}
#: The true state, without noise and quanta.
FULL_STATE = ("observer=full_state", "plant=ideal")

#: ``newton_mpc`` iterated as far as a peer that is converged: a tenth of its own default tolerance.
CONVERGED: dict[str, Any] = {"max_iterations": 50, "tolerance": 1e-4}


def iterations_of(count: int | None) -> tuple[str, ...]:
    """Overrides for a most of Newton iterations: None for the default, 50 for CONVERGED."""
    if count is None:
        return ()
    if count == CONVERGED["max_iterations"]:
        return tuple(f"controller.{key}={value}" for key, value in CONVERGED.items())
    return (f"controller.max_iterations={count}",)


def experiment(*overrides: str) -> Experiment:
    """What ``trms run`` would run with these overrides."""
    from trms_cli.composition.composer import compose
    from trms_cli.library.tasks.experiment import experiment_of

    return experiment_of(compose(list(overrides)).config)


def newton_of(loop_setup: Experiment) -> NewtonMpc:
    """The experiment's controller, which is a ``newton_mpc``."""
    assert isinstance(loop_setup.controller, NewtonMpc)
    return loop_setup.controller


def newton_horizon(periods: int) -> tuple[str, ...]:
    """Overrides for a horizon without move blocking: as many unknowns as a peer has."""
    return (
        f"controller.prediction_horizon={periods}",
        f"controller.move_blocks={json.dumps([1] * periods)}",
    )


def run(chosen: Experiment) -> tuple[Loop, dict[str, Any]]:
    """Close the loop in memory; the loop and its score (``trms.score/1``)."""
    from trms_cli.library.tasks.experiment import topics_of
    from trms_cli.scoring.score import Series, score_tables
    from trms_cli.simulation.history import History

    def make_history(plant: Any) -> History:
        topics = topics_of(chosen, plant)
        return History({t.name: {f.name: f.unit for f in t.fields} for t in topics}, None)

    loop = Loop.start(chosen, make_history)
    loop.run()
    history = loop.history
    tables = {
        topic: Series(history.times(topic), history.columns(topic), history.units[topic])
        for topic in history.fields
        if topic != "/prediction"
    }
    return loop, score_tables(tables, limits={}, duration_s=chosen.duration)
