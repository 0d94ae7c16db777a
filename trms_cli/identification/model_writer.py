"""A fitted model as a YAML that ``model=PATH`` takes anywhere.

The form is that of :mod:`trms_cli.effects.model_file`. A parameter that was fitted carries its
standard deviation ``sd`` (absolute), and its prior as wide as it was before the fit, about the
fitted value: a later fit to other data, or a draw of a rig, starts from what is known now without
counting these data twice.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from trms_cli.core.errors import RecordingError
from trms_cli.core.whole_file import replace_whole
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import ExtendedModel
from trms_cli.identification.problem import FreeParameter
from trms_cli.models.model import Model
from trms_cli.models.newtonian_with_network import KEY as TORQUE_NETWORK
from trms_cli.models.newtonian_with_network import NewtonianWithNetwork
from trms_cli.models.parameters import Parameter

_DIGITS = 6  # significant digits of what a person reads; values keep every bit


@dataclass(frozen=True, kw_only=True)
class ModelOrigin:
    """What a model file says besides values."""

    #: The option of ``configs/model`` that the values belong to; of a model that is none, its class
    #: and arguments
    option: str | Mapping[str, Any]
    limits: Mapping[str, float] = field(default_factory=dict)  #: V, by input
    #: Arguments of each effect that are no size of it, and ``_target_`` if it is not in the library
    effects: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


def model_document(
    name: str,
    model: Model,
    origin: ModelOrigin,
    *,
    values: Mapping[str, float],
    deviations: Mapping[str, float | None],
    free: Iterable[FreeParameter],
    source: str,
) -> dict[str, Any]:
    """The content of a model file.

    ``name``: of the rig. ``model``: with its effects. ``values``: fitted ones; the others keep the
    model's. ``deviations``: standard deviations of the fitted ones, absolute. ``free``: what was
    known of them before. ``source``: what was fitted to what.
    """
    before = {parameter.name: parameter for parameter in free}
    beneath, effects = _layers(model)
    parameters = {}
    for parameter in beneath.parameters:
        at = values.get(parameter.name, parameter.value)
        parameters[parameter.name] = _entry(
            parameter, at, before.get(parameter.name), deviations.get(parameter.name)
        )
    sizes = {
        name: dict(origin.effects.get(name, {}))
        | {
            size.name: float(
                values.get(f"{name}.{size.name}", model.parameters[f"{name}.{size.name}"].value)
            )
            for size in effect.parameters()
        }
        for name, effect in effects.items()
    }
    option = origin.option if isinstance(origin.option, str) else dict(origin.option)
    document: dict[str, Any] = {"name": name, "model": option, "source": source}
    document["parameters"] = parameters
    if origin.limits:
        document["limits"] = dict(origin.limits)
    if sizes:
        document["effects"] = sizes
    if isinstance(beneath, NewtonianWithNetwork) and beneath.torque_network is not None:
        document[TORQUE_NETWORK] = beneath.torque_network.to_data()
    return document


def write_model(document: Mapping[str, Any], path: Path, heading: str = "") -> None:
    """Write a model file, whole or not at all.

    ``heading``: comment lines above the content. Raises RecordingError if the disk refuses.
    """
    import yaml

    comment = "".join(f"# {line}\n" for line in heading.splitlines())
    text = yaml.safe_dump(
        dict(document), sort_keys=False, allow_unicode=True, default_flow_style=None, width=400
    )
    try:
        replace_whole(path, (comment + text).encode())
    except OSError as error:
        raise RecordingError(
            f"cannot be written: {error.strerror or error}",
            where=str(path),
            remedy="make room, or choose another folder: out=FOLDER",
        ) from error


def _layers(model: Model) -> tuple[Model, dict[str, Effect]]:
    """The model beneath all effects, and these in the order in which they were added."""
    effects: list[tuple[str, Effect]] = []
    while isinstance(model, ExtendedModel):
        effects.append((model.effect_name, model.effect))
        model = model.base
    return model, dict(reversed(effects))


def _entry(
    parameter: Parameter, value: float, before: FreeParameter | None, sd: float | None
) -> dict[str, Any]:
    entry: dict[str, Any] = {"value": float(value)}
    if parameter.unit:
        entry["unit"] = parameter.unit
    if before is None:
        if parameter.prior_sd is not None:
            entry["prior_sd"] = parameter.prior_sd
        lower, upper = parameter.lower, parameter.upper
    else:
        if sd is not None and np.isfinite(sd):
            entry["sd"] = _rounded(sd)
        if before.prior_sd is not None and value != 0:
            entry["prior_sd"] = _rounded(before.prior_sd / abs(value))
        lower, upper = before.lower, before.upper
    if np.isfinite(lower):
        entry["lower"] = float(lower)
    if np.isfinite(upper):
        entry["upper"] = float(upper)
    words = parameter.source
    if before is not None:
        words = f"fitted from {before.start:.5g}, no prior"
        if before.prior_sd is not None:
            words = f"fitted; prior {before.prior_mean:.5g} ± {before.prior_sd:.2g}"
    if words:
        entry["source"] = words
    if parameter.description:
        entry["description"] = parameter.description
    return entry


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
