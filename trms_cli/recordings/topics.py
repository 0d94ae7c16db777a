"""Topics of a run log: their fields, units and JSON schemas.

The schemas travel inside the log, so that any MCAP reader knows names and units.

Numbers that are not finite are written as JSON null, which JSON itself demands. The schema
says so in words and by ``nullable``; ``"type": ["number", "null"]`` would be the stricter
spelling, but Foxglove refuses a schema with a list of types and would not open the topic.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

#: Records of a log that tell of its run and of its score, and what is attached to it.
RUN_METADATA, SCORE_METADATA = "trms.run", "trms.score"
CONFIG_ATTACHMENT, PARAMETERS_ATTACHMENT = "config.yaml", "parameters.yaml"
#: The estimates of an observer; and the key of ``trms.run`` with the topics (as JSON) of which not
#: each sample is in the log, and each how manyth is.
ESTIMATE_TOPIC, THINNED_KEY = "/estimate", "logged_every"
#: How the names of a viewer's schemas begin; their messages hold no samples, and readers pass them.
VIEWER_SCHEMAS = "foxglove."

Kind = Literal["number", "integer", "text", "boolean", "array"]


@dataclass(frozen=True)
class Field:
    """One value of a message."""

    name: str  #: Key in the JSON message
    unit: str = "1"  #: SI unit; "1" for a plain number, "" for text and truth values
    description: str = ""  #: What it is, without the unit
    kind: Kind = "number"  #: "number", "integer", "text", "boolean" or "array" (of numbers)

    def json_schema(self) -> dict[str, Any]:
        """Return the property's JSON schema; the unit stands in its description."""
        text = self.description or self.name
        schema: dict[str, Any] = {"type": "string" if self.kind == "text" else self.kind}
        if self.kind in ("number", "integer"):
            schema["nullable"] = True
            text = f"{text} [{self.unit}]; null when not finite or missing"
        elif self.kind == "array":
            schema["items"] = {"type": "number", "nullable": True}
            text = f"{text} [{self.unit}]; null where not finite"
        schema["description"] = text
        if self.unit:
            schema["unit"] = self.unit
        return schema


@dataclass(frozen=True)
class Topic:
    """A named stream of messages that all have the same fields."""

    name: str  #: With its slash: "/command"
    fields: tuple[Field, ...]  #: In the order in which values are written
    description: str = ""  #: One sentence for the schema

    def __post_init__(self) -> None:
        names = self.field_names
        if len(set(names)) != len(names):
            twice = sorted({n for n in names if names.count(n) > 1})
            raise ValueError(f"topic {self.name}: fields named twice: {', '.join(twice)}")

    @property
    def field_names(self) -> tuple[str, ...]:
        """Names in writing order."""
        return tuple(field.name for field in self.fields)

    @property
    def schema_name(self) -> str:
        """Name of the schema record: "trms.plant_state" for "/plant/state"."""
        return "trms." + self.name.strip("/").replace("/", "_")

    def json_schema(self) -> dict[str, Any]:
        """Return the JSON schema of the topic's messages."""
        return {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": self.schema_name,
            "description": self.description,
            "type": "object",
            "properties": {field.name: field.json_schema() for field in self.fields},
            "required": list(self.field_names),
            "additionalProperties": False,
        }


@dataclass(frozen=True)
class EncodedTopic:
    """A stream of messages that come as JSON already, with somebody else's schema."""

    name: str  #: With its slash: "/tf"
    schema_name: str  #: As its publisher calls it: "foxglove.FrameTransforms"
    schema: bytes  #: The JSON schema as published


EVENT_TOPIC = Topic(
    "/event",
    (
        Field("kind", "", "what happened, in one word", "text"),
        Field("source", "", "the part that it happened to", "text"),
        Field("message", "", "what happened, as a sentence", "text"),
        Field("value", "1", "a number that belongs to it, in the unit the message names"),
    ),
    "Faults, saturation begun or ended, solver trouble, a person's note",
)

CONTROLLER_TOPIC = Topic(
    "/controller",
    (
        Field("solve_time_s", "s", "wall time of the whole control step"),
        Field("linearise_time_s", "s", "wall time of linearising the model"),
        Field("qp_time_s", "s", "wall time inside the QP solver"),
        Field("iterations", "1", "iterations of the outer solver", "integer"),
        Field("status", "", "the solver's outcome, by name", "text"),
        Field("objective", "1", "value of the cost function"),
        Field("slack", "1", "largest violation of a soft constraint"),
        Field("kkt_residual", "1", "norm of the optimality conditions' residual"),
        Field("fallback", "", "a fall-back acted in place of the solution", "boolean"),
        Field("deadline_missed", "", "the step took longer than its deadline", "boolean"),
        Field("message", "", "the solver's sentence, empty when all is well", "text"),
        Field("mode", "", "of the loop: normal, degraded or landing", "text"),
        Field("reasons", "", "why the mode is not normal, empty when it is", "text"),
        Field("terminal_residual", "1", "how far the plan ends from where it must"),
    ),
    "The controller's own words on each sample",
)


TIMING_TOPIC = Topic(
    "/timing",
    (
        Field("due_s", "s", "when the sample was due"),
        Field("lateness_s", "s", "by how much later it began"),
        Field("reading_s", "s", "from its beginning until the reading was there"),
        Field("command_s", "s", "from the reading until the command was sent"),
        Field("observer_s", "s", "from the reading until the estimate was made"),
        Field("controller_s", "s", "from the estimate until the command was decided"),
        Field("log_s", "s", "of writing down the sample before"),
    ),
    "When a sample of a real rig was due, when it began, and what it took",
)


def landing_topic(signals: Iterable[Field]) -> Topic:
    """Build /landing: commands and readings after the run's last sample, until the rig rests."""
    return Topic("/landing", tuple(signals), "Commands and readings of the landing after the run")


def standard_topics(
    *,
    references: Sequence[Field] = (),
    inputs: Sequence[Field] = (),
    outputs: Sequence[Field] = (),
    states: Sequence[Field] = (),
    estimates: Sequence[Field] = (),
    disturbances: Sequence[Field] = (),
    controller: bool = True,
    prediction: bool = False,
) -> list[Topic]:
    """Build the topics of a run from its signals, always with /event, which any run may need.

    A topic whose signals are absent is not created: a replayed recording has no true state.

    ``references``: per controlled axis, named as the output it is for. ``inputs``, ``outputs``:
    commands as applied, and measured channels. ``estimates``: states of the observer, in its order;
    standard deviations are added to them, and the prediction, innovation and innovation's deviation
    of each output. ``disturbances``: known ones. ``prediction``: whether the controller tells its
    predictions.
    """
    topics = [
        Topic("/reference", tuple(references), "What the outputs are asked to be"),
        Topic("/command", tuple(inputs), "Inputs as applied to the plant, after limits"),
        Topic("/measurement", tuple(outputs), "Outputs as measured; null: no sample"),
        Topic("/disturbance", tuple(disturbances), "Known disturbances acting on the plant"),
        Topic("/plant/state", tuple(states), "The simulated plant's true state"),
        Topic("/estimate", _estimate_fields(estimates, outputs), "The observer's estimate"),
    ]
    topics = [topic for topic in topics if topic.fields]
    if controller and inputs:
        topics.append(CONTROLLER_TOPIC)
        if prediction:
            topics.append(prediction_topic([*(estimates or states), *outputs, *inputs]))
    topics.append(EVENT_TOPIC)
    return topics


def prediction_topic(signals: Iterable[Field]) -> Topic:
    """Build /prediction: the time from now and one array per signal over the horizon."""
    arrays = {"time": Field("time", "s", "time from now", "array")}
    for signal in signals:
        what = f"predicted {signal.description or signal.name}"
        arrays.setdefault(signal.name, Field(signal.name, signal.unit, what, "array"))
    return Topic("/prediction", tuple(arrays.values()), "Predicted trajectories over the horizon")


def _estimate_fields(states: Sequence[Field], outputs: Sequence[Field]) -> tuple[Field, ...]:
    if not states:
        return ()
    fields = [Field(s.name, s.unit, f"estimated {s.description or s.name}") for s in states]
    for s in states:
        what = f"standard deviation of the estimated {s.description or s.name}"
        fields.append(Field(f"sd_{s.name}", s.unit, what))
    for y in outputs:
        what = y.description or y.name
        fields.append(Field(f"predicted_{y.name}", y.unit, f"one-step prediction of {what}"))
        fields.append(Field(f"innovation_{y.name}", y.unit, f"measured minus predicted {what}"))
        sd = f"standard deviation expected of the innovation of {what}"
        fields.append(Field(f"innovation_sd_{y.name}", y.unit, sd))
    return tuple(fields)
