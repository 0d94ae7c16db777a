"""From a composed configuration to an experiment, its log's topics and its records."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import yaml

from trms_cli.composition.composer import Composition
from trms_cli.composition.plain_values import number, whole_number
from trms_cli.core.errors import ConfigurationError, interrupted_code
from trms_cli.core.invocation import command_line
from trms_cli.core.plugins import build, check_contract, construct, nearest
from trms_cli.core.versions import versions
from trms_cli.core.wording import plant_in_full
from trms_cli.library.tasks.task import Interrupted
from trms_cli.models.model import Model, Signal
from trms_cli.models.parameters import ParameterSet
from trms_cli.plants.landing import landing_of
from trms_cli.plants.plant import PlantRun
from trms_cli.recordings.topics import (
    ESTIMATE_TOPIC,
    TIMING_TOPIC,
    Field,
    Topic,
    landing_topic,
    prediction_topic,
    standard_topics,
)
from trms_cli.scoring.score import LIMITS_KEY
from trms_cli.simulation.closed_loop import Experiment
from trms_cli.simulation.pace import LatePolicy

if TYPE_CHECKING:
    from trms_cli.recordings.for_model import RecordedRun
    from trms_cli.scoring.score import Series
    from trms_cli.simulation.history import History

#: Keys of the log's ``trms.run`` record, each with JSON: what ``trms run --from LOG`` reads.
OVERRIDES_KEY, CONFIG_DIRS_KEY, VERSIONS_KEY = "overrides", "config_dirs", "versions"
#: The same, with the option chosen in each group: what `trms compare` tells runs apart by.
CHOICES_KEY = "choices"
#: The plugins that a closed loop calls, by their keys.
PARTS = ("plant", "observer", "controller", "ref", "supervisor", "gap_watch")


def experiment_of(config: Mapping[str, Any]) -> Experiment:
    """Build every plugin of a composed configuration.

    Raises ConfigurationError for the first key that is wrong.
    """
    simulation = config["sim"]
    parts = {key: build(config[key], key) for key in ("model", *PARTS)}
    for key in PARTS:
        check_contract(parts[key], key)
    return Experiment(
        model=parts["model"],
        plant=parts["plant"],
        observer=parts["observer"],
        controller=parts["controller"],
        reference=parts["ref"],
        duration=number(simulation["duration"], "sim.duration"),
        sample_time=number(simulation["sample_time"], "sim.sample_time"),
        seed=whole_number(config["seed"], "seed"),
        prediction_every=whole_number(simulation["prediction_every"], "sim.prediction_every"),
        supervisor=parts["supervisor"],
        pace=_one_of(simulation.get("pace"), (None, "real_time", "simulated"), "sim.pace"),
        late=construct(LatePolicy, simulation.get("late") or {}, "sim.late"),
        gap_watch=parts["gap_watch"],
    )


def _one_of(value: Any, allowed: tuple[Any, ...], where: str) -> Any:
    """Raises ConfigurationError for what is not allowed."""
    if value not in allowed:
        names = [str(name) for name in allowed if name is not None]
        raise ConfigurationError(f"{value!r} given", where=where, remedy=nearest(str(value), names))
    return value


def raise_explained(
    error: Exception, experiment: Experiment, time: float, log: Path | None = None
) -> NoReturn:
    """Raise a plugin's exception at `time` (simulated, s) as a message that names it; others as is.

    `log`: where the run up to there can be read.
    """
    from trms_cli.core.plugins import plugin_failure

    parts = {
        "controller": experiment.controller,
        "observer": experiment.observer,
        "plant": experiment.plant,
        "ref": experiment.reference,
        "supervisor": experiment.supervisor,
        "gap_watch": experiment.gap_watch,
    }
    failure = plugin_failure(error, parts, time)
    if failure is None:
        raise error
    if log is not None and str(log) != failure.where:
        hint = f"the log up to {time:.2f} s: {log}"
        failure.remedy = f"{failure.remedy}\n{hint}" if failure.remedy else hint
    if failure is error:
        raise error
    raise failure from error


def topics_of(experiment: Experiment, plant: PlantRun) -> list[Topic]:
    """The topics of a closed-loop run's log."""
    model = experiment.model
    states = [_field(signal) for signal in model.states]
    controlled = [states[model.state_index(name)] for name in model.controlled]
    inputs = [_field(signal) for signal in plant.inputs]
    # A controller that follows nothing has no reference to be logged or scored.
    followed = getattr(experiment.controller, "follows_reference", True)
    topics = standard_topics(
        references=controlled if followed else [],
        inputs=inputs,
        outputs=[_field(signal) for signal in plant.outputs],
        states=[_field(signal) for signal in plant.states],
        estimates=[*states, *(_field(signal) for signal in model.disturbances)],
        disturbances=[
            Field(f"d_{equation}", "N*m", f"measured torque on {equation}")
            for equation in plant.known_disturbances
        ],
        controller=True,
    )
    topics.append(prediction_topic([*states, *inputs]))
    if experiment.in_real_time:
        topics.append(TIMING_TOPIC)
    if landing_of(experiment.plant).after_run:
        topics.append(landing_topic([*inputs, *(_field(signal) for signal in plant.outputs)]))
    return topics


def run_metadata(
    composition: Composition, model: Model, plant: PlantRun | RecordedRun, revision: str
) -> dict[str, str]:
    """What the log says of the run besides its samples."""
    limits = {
        name: [low, high]
        for name, (low, high) in limits_of(plant, model).items()
        if name not in model.stops or high < float("inf")
    }
    labels = composition.choice_labels
    own = str(getattr(getattr(plant, "model", None), "name", ""))
    return {
        "command": command_line(),
        "model": labels.get("model", ""),
        "plant": plant_in_full(labels, composition.config["plant"], own),
        "seed": str(composition.config["seed"]),
        "git": revision,
        VERSIONS_KEY: json.dumps(versions()),
        "platform": platform.platform(),
        OVERRIDES_KEY: json.dumps(list(composition.overrides)),
        CHOICES_KEY: json.dumps(composition.choices),
        CONFIG_DIRS_KEY: json.dumps([str(folder) for folder in composition.config_dirs]),
        LIMITS_KEY: json.dumps(limits),
    }


def limits_of(rig: PlantRun | RecordedRun, model: Model) -> dict[str, tuple[float, float]]:
    """Of the inputs (V) and of the angles (rad), by name."""
    lower, upper = rig.input_limits
    limits = {
        signal.name: (low, high)
        for signal, low, high in zip(rig.inputs, lower.tolist(), upper.tolist(), strict=True)
    }
    return limits | {name: (-stop, stop) for name, stop in model.stops.items()}


def units_of(topics: Iterable[Topic]) -> dict[str, dict[str, str]]:
    """Units of the fields of topics, by the names of both."""
    return {topic.name: {field.name: field.unit for field in topic.fields} for topic in topics}


def logged_every(config: Mapping[str, Any]) -> dict[str, int]:
    """Topics of which not each sample is logged, and each how manyth is; 0: none.

    Raises ConfigurationError when ``sim.estimate_every`` is no whole number.
    """
    every = whole_number(config["sim"].get("estimate_every", 1), "sim.estimate_every")
    return {} if every == 1 else {ESTIMATE_TOPIC: every}


def tables_of(history: History) -> dict[str, Series]:
    """What a history holds as a score wants it, by topic."""
    from trms_cli.scoring.score import Series

    return {
        topic: Series(history.times(topic), history.columns(topic), history.units[topic])
        for topic in history.fields
        if topic != "/prediction"
    }


def interruption_of(
    error: KeyboardInterrupt, time: float, log: Path, then: str = ""
) -> Interrupted:
    """What is raised for a run that was stopped at a `time` (s), with what to do `then`."""
    words = f"\ninterrupted at {time:.2f} s; the log up to there is complete and readable\n"
    words += f"  log  {log}\n{then}"
    return Interrupted(log.parent, exit_code=interrupted_code(error), words=words)


def attachments(
    composition: Composition, model: Model, true_parameters: ParameterSet | None
) -> dict[str, tuple[str, bytes]]:
    """The resolved configuration, and the parameters of model and rig, as YAML."""
    text = _parameters_text(_as_data(model.parameters), _as_data(true_parameters))
    return {
        "config.yaml": ("application/yaml", composition.yaml.encode()),
        "parameters.yaml": ("application/yaml", text.encode()),
    }


#: Name, value and unit of each parameter.
_ParameterData = tuple[tuple[str, float, str], ...]


@lru_cache(maxsize=4)  # those of a sweep's runs are often the same
def _parameters_text(model: _ParameterData, plant: _ParameterData | None) -> str:
    parameters = {
        whose: {name: {"value": value, "unit": unit} for name, value, unit in data}
        for whose, data in (("model", model), ("plant", plant))
        if data is not None
    }
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    return str(yaml.dump(parameters, Dumper=dumper, sort_keys=False, allow_unicode=True))


def _field(signal: Signal) -> Field:
    return Field(signal.name, signal.unit, signal.description)


def _as_data(parameters: ParameterSet | None) -> _ParameterData | None:
    return None if parameters is None else tuple((p.name, p.value, p.unit) for p in parameters)
