"""Sets of sensors that are worth a comparison."""

from __future__ import annotations

from collections.abc import Sequence

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.models.model import Model, names


def sensor_sets(
    model: Model, given: Sequence[Sequence[str]] | None, where: str = "study.sensors"
) -> tuple[tuple[str, ...], ...]:
    """The sets asked for, or the usual ones.

    The usual ones are everything, the angles with each tachometer, the angles alone, and each
    sensor alone.

    Raises ConfigurationError for a name that the model does not measure, and for an empty set.
    """
    known = names(model.outputs)
    if given is not None:
        for one in given:
            for name in one:
                if name not in known:
                    raise ConfigurationError(
                        f"{name!r} is not measured", where=where, remedy=nearest(name, known)
                    )
            if not one:
                raise ConfigurationError(
                    "an empty set of sensors given",
                    where=where,
                    remedy="give names, as 'study.sensors=[[alpha_v,alpha_h],[alpha_v]]'",
                )
        return tuple(tuple(dict.fromkeys(one)) for one in given)
    angles = tuple(signal.name for signal in model.outputs if signal.unit == "rad")
    others = [name for name in known if name not in angles]
    sets = [known, *((*angles, name) for name in others), angles, *((name,) for name in known)]
    return tuple(dict.fromkeys(one for one in sets if one))


def set_words(model: Model, sensors: Sequence[str]) -> str:
    """``all``, ``angles``, ``angles, omega_v``, ``alpha_v``."""
    known = names(model.outputs)
    if len(sensors) == len(known) and len(known) > 1:
        return "all"
    angles = tuple(signal.name for signal in model.outputs if signal.unit == "rad")
    if len(angles) > 1 and set(angles) <= set(sensors):
        return ", ".join(["angles", *(name for name in sensors if name not in angles)])
    return ", ".join(sensors)
