"""The loop of a composed experiment, run in memory."""

from collections.abc import Iterable

from trms_cli.composition.composer import compose
from trms_cli.library.tasks.experiment import experiment_of, topics_of
from trms_cli.recordings.topics import Topic
from trms_cli.simulation.closed_loop import Experiment, Loop
from trms_cli.simulation.history import History


def composed(*overrides: str) -> Experiment:
    return experiment_of(compose(list(overrides)).config)


def units_of(topics: Iterable[Topic]) -> dict[str, dict[str, str]]:
    """What a history is told of topics: the unit of each field."""
    return {topic.name: {field.name: field.unit for field in topic.fields} for topic in topics}


def started(experiment: Experiment) -> Loop:
    """Begun, with every topic kept and nothing written."""
    return Loop.start(
        experiment, lambda plant: History(units_of(topics_of(experiment, plant)), None)
    )


def looped(experiment: Experiment) -> Loop:
    """Run to its end in memory."""
    loop = started(experiment)
    loop.run()
    return loop
