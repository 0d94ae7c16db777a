"""What black-box models of a rig share: signals, limits, axes, and the YAML that they stand in.

A black box steps from sample to sample. Its first states are its outputs under their own names;
each has a disturbance, an acceleration. One for each output lets an observer explain any constant
difference between the rig and its model.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from trms_cli.core.data_file import read_bytes
from trms_cli.core.errors import ModelError, TrmsError
from trms_cli.core.plugins import require_known
from trms_cli.models.beam_rig import ROTORS
from trms_cli.models.discrete import SteppedModel
from trms_cli.models.model import RigAxis, Signal, names
from trms_cli.models.parameters import ParameterSet, check_limits

#: RigAxis of each angle and input of each rotor, as other models name them.
_AXES = {"alpha_v": "pitch", "alpha_h": "yaw"}
_ROTORS = {rotor.input: name for name, rotor in ROTORS.items()}
#: Unit of an output that is an angle.
ANGLE = "rad"
#: Bound of a command that no limit is given for, by unit.
_LIMITS = {"V": 2.5, "1": 1.0}


class BlackBox(SteppedModel):
    """A model that was learnt from samples: it measures its first states.

    Raises ModelError if a limit names no input or angle.

    ``more_states``: what follows the outputs in the state. ``limits``: symmetric bounds by input,
    and mechanical stops by angle (rad). Inputs without one have 2.5 V, or 1 for normalised ones.
    """

    bench_sizes = True

    def __init__(
        self,
        outputs: Sequence[Signal],
        inputs: Sequence[Signal],
        more_states: Sequence[Signal],
        sample_time: float,
        *,
        name: str,
        limits: Mapping[str, float] | None = None,
    ) -> None:
        self.name, self.sample_time = name, sample_time
        self.outputs, self.inputs = tuple(outputs), tuple(inputs)
        self.states = (*self.outputs, *more_states)
        self.disturbances = tuple(
            Signal(f"{y.name}_push", _acceleration_unit(y), f"acceleration added to {y.name}")
            for y in self.outputs
        )
        self.parameters = ParameterSet([], name)
        angles = tuple(y.name for y in self.outputs if y.unit == ANGLE)
        self.controlled = angles or names(self.outputs)
        bounds = limits or {}
        # A model of one axis keeps the limits of the whole rig in its file.
        known = {*names(self.inputs), *angles, *_AXES, *_ROTORS}
        check_limits(bounds, known, "limits")
        self.input_limits = {u.name: _limit(u, bounds) for u in self.inputs}
        self.stops = {angle: bounds.get(angle, np.inf) for angle in angles}
        self.axes = {_AXES.get(angle, angle): RigAxis(angle, f"{angle}_push") for angle in angles}
        self.rotors = {
            _ROTORS[u]: replace(ROTORS[_ROTORS[u]], torque="")
            for u in names(self.inputs)
            if u in _ROTORS
        }

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return x[: self.n_y, 0]


@dataclass(frozen=True, kw_only=True, eq=False)
class BlackBoxFile:
    """What the file of every black box holds; a kind adds its body."""

    kind: ClassVar[str]  #: Value of ``model`` in such a file
    body: ClassVar[tuple[str, ...]]  #: Fields of the kind's own, each with ``to_data``

    name: str
    #: Bounds by input, and mechanical stops by angle (rad)
    limits: Mapping[str, float] = field(default_factory=dict)
    source: str = ""  #: How the model was made, and of what
    #: Option of ``configs/model`` with the rig that it is a model of; empty for none
    rig: str = ""
    #: A record of how it was made, plain data
    training: Mapping[str, Any] = field(default_factory=dict)
    #: Options of ``configs/effect`` by name, with their sizes
    effects: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @classmethod
    def keys(cls) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Keys that a file must have, and those that it may have."""
        common = ("source", "rig", "limits", "training", "effects")
        return ("name", "model", *cls.body), common

    def to_data(self) -> dict[str, Any]:
        """Plain data for the YAML; what is empty is left out."""
        data: dict[str, Any] = {"name": self.name, "model": self.kind}
        for key in ("source", "rig", "limits", "effects"):
            if value := getattr(self, key):
                data[key] = value if isinstance(value, str) else dict(value)
        data |= {key: getattr(self, key).to_data() for key in self.body}
        if self.training:
            data["training"] = dict(self.training)
        return data


def common_entries(data: Mapping[str, Any], label: str) -> dict[str, Any]:
    """The fields of :class:`BlackBoxFile` that the content of a file gives."""
    return {
        "name": str(data["name"]),
        "limits": numbers_at(data, "limits", label),
        "source": str(data.get("source") or ""),
        "rig": str(data.get("rig") or ""),
        "training": mapping_at(data, "training", label),
        "effects": mapping_at(data, "effects", label),
    }


@contextmanager
def complaints_by_file(path: str) -> Iterator[None]:
    """Complaints of a model that a file describes name the file and its key."""
    try:
        yield
    except TrmsError as error:
        raise ModelError(
            error.problem, where=f"{path}: {error.where}", remedy=error.remedy
        ) from error


def remembered_signals(signals: Sequence[Signal], count: int) -> list[Signal]:
    """Signals one, two, … samples ago, all of one sample together."""
    return [
        Signal(f"{s.name}_lag{k}", s.unit, f"{s.name} {k} sample{'s' if k > 1 else ''} ago")
        for k in range(1, count + 1)
        for s in signals
    ]


def _limit(command: Signal, bounds: Mapping[str, float]) -> float:
    if command.name not in bounds and command.unit not in _LIMITS:
        raise ModelError(
            f"no limit for {command.name!r} in {command.unit}",
            where=f"limits.{command.name}",
            remedy="give the largest command",
        )
    return bounds.get(command.name, _LIMITS.get(command.unit, np.inf))


def _acceleration_unit(output: Signal) -> str:
    if output.unit in (ANGLE, "rad/s"):
        return "rad/s^2"
    return f"{output.unit}/s"


def kind_of_file(path: str, body: Mapping[str, str]) -> str:
    """The kind of black box that a file says that it holds; empty for none or an unreadable file.

    ``body``: by kind, the key that only files of that kind have.
    """
    from trms_cli.core.yaml_data import MOST_BYTES

    file = Path(path).expanduser()
    try:
        data = mapping_of(file, read_bytes(file, MOST_BYTES), "")
    except (OSError, TrmsError):
        return ""
    for kind, key in body.items():
        if data.get("model") == kind or key in data:
            return kind
    return ""


def mapping_of(path: Path, text: bytes, remedy: str) -> dict[str, Any]:
    """The mapping that a YAML text holds; ModelError with the remedy for what is none."""
    import yaml

    from trms_cli.core.yaml_data import load_yaml

    try:
        data = load_yaml(text)
    except yaml.YAMLError as error:
        raise ModelError(
            f"not valid YAML: {str(error).splitlines()[0]}", where=str(path), remedy=remedy
        ) from error
    if not isinstance(data, dict):
        raise ModelError("not a mapping", where=str(path), remedy=remedy)
    return data


def check_file(data: Mapping[str, Any], label: str, content: type[BlackBoxFile], noun: str) -> None:
    """Refuse a file that lacks a key, has an unknown one, or holds another kind of model.

    ``noun``: what the file is, as ``network``.
    """
    required, optional = content.keys()
    for key in required:
        if key not in data:
            raise ModelError(
                f"key {key!r} is missing",
                where=label,
                remedy=f"a {noun} file has {', '.join(required)}, and may have "
                f"{', '.join(optional)}",
            )
    for key in data:
        place = f"{label}: {key}"
        require_known(str(key), (*required, *optional), f"unknown key {key!r}", place, ModelError)
    if data["model"] != content.kind:
        raise ModelError(
            f"{data['model']!r} given",
            where=f"{label}: model",
            remedy=f"a {noun} is a {content.kind!r}",
        )


def mapping_at(data: Mapping[str, Any], key: str, label: str) -> dict[str, Any]:
    """A mapping of a file, empty where there is none."""
    value = data.get(key) or {}
    if not isinstance(value, dict):
        raise ModelError(f"{value!r} given", where=f"{label}: {key}", remedy="give a mapping")
    return value


def numbers_at(data: Mapping[str, Any], key: str, label: str) -> dict[str, float]:
    """A mapping of names to numbers of a file, empty where there is none."""
    values = {}
    for name, value in mapping_at(data, key, label).items():
        try:
            values[str(name)] = float(value)
        except (TypeError, ValueError):
            raise ModelError(
                f"{value!r} given", where=f"{label}: {key}.{name}", remedy="give a number"
            ) from None
    return values
