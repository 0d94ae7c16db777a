"""The loop of a composed experiment, run in memory."""

from typing import Any

from trms_cli.composition.composer import compose
from trms_cli.library.tasks.experiment import experiment_of, topics_of
from trms_cli.simulation.closed_loop import Experiment, Loop
from trms_cli.simulation.history import History


def composed(*overrides: str) -> Experiment:
    return experiment_of(compose(list(overrides)).config)


def looped(experiment: Experiment) -> Loop:
    """Run, with every topic kept and nothing written."""

    def keep(plant: Any) -> History:
        topics = topics_of(experiment, plant)
        return History({t.name: {f.name: f.unit for f in t.fields} for t in topics}, None)

    loop = Loop.start(experiment, keep)
    loop.run()
    return loop
