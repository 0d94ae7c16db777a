"""What commands that hold models against recordings share: model, effects, recordings, driven."""

from collections.abc import Mapping, Sequence
from typing import Any

from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.core.plugins import TARGET, build
from trms_cli.effects.extended_model import extend_model
from trms_cli.identification.dataset import Dataset
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.model import Model


def several(value: Any, where: str) -> tuple[str, ...]:
    """One name or several, as several.

    Raises ConfigurationError if it is neither; ``where`` is the key that it was given by.
    """
    items = [value] if isinstance(value, str) else value
    if not isinstance(items, list | tuple) or not all(
        isinstance(item, str) and item for item in items
    ):
        raise ConfigurationError(
            f"{value!r} given", where=where, remedy=f"{where}=NAME, or '{where}=[NAME,NAME]'"
        )
    return tuple(items)


def model_of(config: Mapping[str, Any]) -> Model:
    """The model of a composed configuration, with its effects.

    Raises TrmsError for a plugin that cannot be built, and for one that is no model.
    """
    model = build(config["model"], "model")
    if not isinstance(model, Model):
        raise ConfigurationError(
            f"{config['model'].get(TARGET)!r} is no model",
            where="model",
            remedy="choose one that `trms list model` shows",
        )
    effects = {
        name: build(node, f"effect.{name}") for name, node in (config.get("effect") or {}).items()
    }
    return extend_model(model, effects)


def driven_model(model: Model, driven: Sequence[str]) -> Model:
    """The model whose states ``driven`` are prescribed; itself for none.

    Raises TrmsError for what is no state that can be prescribed.
    """
    if not driven:
        return model
    try:
        return DrivenModel(model, driven)
    except TrmsError as error:
        error.where = "driven"
        raise


def driven_recordings(recordings: Sequence[Dataset], driven: Sequence[str]) -> tuple[Dataset, ...]:
    """The recordings for :func:`driven_model`."""
    return tuple(dataset.driven_by(driven) if driven else dataset for dataset in recordings)
