"""From composed configurations to models, recordings and options of a validation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from trms_cli.commands.recording_request import (
    driven_model,
    driven_recordings,
    model_of,
    several,
)
from trms_cli.commands.run_assembly import check_out
from trms_cli.commands.run_assembly import versions as versions
from trms_cli.commands.validate_models import shown_names
from trms_cli.composition.composer import Composition
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import TARGET, build
from trms_cli.identification.admission import Admission, admit, together
from trms_cli.identification.data import DataOptions, load_datasets
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.validation.options import ValidationOptions
from trms_cli.models.model import Model

if TYPE_CHECKING:
    from trms_cli.identification.validation.validate import ModelValidation

_OPTIONS = "trms_cli.identification.validation.options.ValidationOptions"
#: What a channel without declared noise is given, so that filters stay invertible.
_NO_NOISE = 1e-6
#: Keys of the configuration that make up a :class:`ValidationOptions`.
_OPTION_KEYS = ("horizons", "windows", "predictor", "tests", "block", "seed")


@dataclass(frozen=True)
class Asked:
    """What is validated."""

    models: Mapping[str, Model]  #: By the name that is shown
    datasets: Mapping[str, Sequence[Dataset]]  #: The recordings as each model takes them
    options: ValidationOptions
    data: DataOptions
    driven: tuple[str, ...]
    effects: tuple[str, ...]
    page: bool
    admission: Admission  #: What was found in the recordings, by all models together


def validation_of(compositions: Sequence[Composition], given: Sequence[str]) -> Asked:
    """Build everything that was asked for.

    Raises TrmsError for the first key or recording that is wrong.
    """
    config = compositions[0].config
    options = build({TARGET: _OPTIONS, **{key: config[key] for key in _OPTION_KEYS}})
    data = build(config["data"], "data")
    real = several(config["real"], "real")
    driven = several(config["driven"], "driven")
    if not isinstance(config["page"], bool):
        raise ConfigurationError(f"{config['page']!r} given", where="page", remedy="true or false")
    check_out(config["out"])
    models: dict[str, Model] = {}
    recordings: dict[str, Sequence[Dataset]] = {}
    admissions: dict[str, Admission] = {}
    shown = shown_names(given) if given else [_name_of(compositions[0])]
    for name, composition in zip(shown, compositions, strict=True):
        model = model_of(composition.config)
        simulated = driven_model(model, driven)
        loaded = load_datasets(real, model, data)
        admissions[name] = admit(loaded, model, purpose="validation")
        models[name], recordings[name] = simulated, loaded
    admission = together(admissions)
    admission.require()
    datasets = {name: driven_recordings(loaded, driven) for name, loaded in recordings.items()}
    for driven_ones in datasets.values():
        _check_noise(driven_ones)
    return Asked(
        models=models,
        datasets=datasets,
        options=options,
        data=data,
        driven=driven,
        effects=tuple(config["effect"] or ()),
        page=config["page"],
        admission=admission,
    )


def _name_of(composition: Composition) -> str:
    """What the one model is called: its option, or the stem of its file."""
    node = composition.config["model"]
    path = node.get("path") if isinstance(node, Mapping) else None
    if composition.choices.get("model") == "from_file" and isinstance(path, str):
        return shown_names([path])[0]
    return str(composition.choices.get("model"))


def _check_noise(datasets: Sequence[Dataset]) -> None:
    """A channel without noise would weigh infinitely much, and no band would hold."""
    for dataset in datasets:
        for signal, sd in zip(dataset.outputs, dataset.noise_sd, strict=True):
            if not sd > _NO_NOISE:
                raise ConfigurationError(
                    f"no noise of {signal.name} is declared",
                    where="data.noise_sd",
                    remedy=f"data.noise_sd.{signal.name}=… ({signal.unit}), or "
                    "data.noise_sd=estimate",
                )


def calibrated_where_asked(
    validations: Sequence[ModelValidation], asked: Asked, progress: Callable[[str], None]
) -> tuple[list[ModelValidation], list[str]]:
    """p-values from simulation, where they are asked for; and what to say of it."""
    if asked.options.tests.calibration != "simulated":
        return list(validations), []
    from trms_cli.identification.validation.validate import calibrated

    done, notes = [], []
    wanted = asked.options.tests.simulations
    for validation in validations:

        def tell(count: int, name: str = validation.name) -> None:
            progress(f"{name}: simulation {count} of {wanted}")

        tests = calibrated(validation, asked.data.quantum, tell)
        if tests is None:
            notes.append(
                f"{validation.name}: left alone over the recording it leaves the range of what was "
                "measured, so its p-values are not from simulations"
            )
        done.append(validation if tests is None else replace(validation, tests=tests))
    return done, notes


def warnings_of(asked: Asked) -> list[dict[str, str]]:
    """What the recordings are not as good for as they might be, for the document."""
    return Admission(asked.admission.warnings).as_data()


def notes_on(asked: Asked) -> list[str]:
    """What a reader should know of how the figures came about."""
    return list(dict.fromkeys(_notes(asked)))


def _notes(asked: Asked) -> Iterator[str]:
    if asked.driven:
        yield f"driven by the measured {', '.join(asked.driven)}: its errors have no part here"
    if asked.effects:
        yield f"with {', '.join(asked.effects)} added to the model"
    if asked.options.windows.start == "fitted":
        yield (
            "the starts of the windows were fitted to the windows themselves: the errors flatter, "
            "most over short horizons"
        )
    several = len(asked.models) > 1
    for model, datasets in asked.datasets.items():
        for dataset in datasets:
            prefix = f"{model}, {dataset.name}: " if several else f"{dataset.name}: "
            for remark in dataset.remarks:
                yield prefix + remark


def objective(document: Mapping[str, Any]) -> float | None:
    """What a sweeper minimises: errors over those of no change, geometric mean."""
    if "models" in document:
        return None
    ratios = [
        row["rms"] / row["unchanged_rms"]
        for rows in document["by_horizon"].values()
        for row in rows.values()
        if row["rms"] and row["unchanged_rms"]
    ]
    return float(np.exp(np.mean(np.log(ratios)))) if ratios else None
