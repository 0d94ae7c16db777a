"""From a composed configuration to a fit problem: model, recordings, parameters, method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from trms_cli.composition.composer import Composition
from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.core.plugins import TARGET, build
from trms_cli.identification.admission import Admission, admit
from trms_cli.identification.data import DataOptions, load_datasets
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.problem import (
    FitProblem,
    FreeParameter,
    Method,
    Prior,
    acting_parameters,
    free_parameters,
)
from trms_cli.library.tasks.subject import driven_model, driven_recordings, model_of, several
from trms_cli.models.model import Model

#: Keys of the configuration that are plugins of their own.
_GROUPS = ("model", "effect", "method", "data", "experiment")
_Positive = Annotated[float, Meta(gt=0)]
_PRIOR_KEYS = {"mean", "sd", "relative_sd"}
#: Fewer samples than this cannot be fitted or judged.
_FEWEST_SAMPLES = 20


@dataclass(frozen=True, kw_only=True)
class WindowKeys:
    """``windows``."""

    length: _Positive = 10.0  #: s
    stride: _Positive | None = None  #: s


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """``validation``: what is kept from the fit."""

    share: Annotated[float, Meta(ge=0, lt=1)] = 0.25  #: Of each recording, its end
    real: str | tuple[str, ...] | None = None  #: Other recordings instead


@dataclass(frozen=True, kw_only=True)
class IdentifyOptions:
    """The keys of ``configs/identify.yaml`` that are no group."""

    real: str | tuple[str, ...]
    free: str | tuple[str, ...] = "priors"
    priors: Mapping[str, Any] = field(default_factory=dict)  #: By parameter
    #: the size of an effect may stand nested
    bounds: Mapping[str, Any] = field(default_factory=dict)
    driven: str | tuple[str, ...] = ()
    windows: WindowKeys = field(default_factory=WindowKeys)
    validation: HeldOut = field(default_factory=HeldOut)
    robust: _Positive | None = 3.0
    discrepancy: Literal["estimate", "none"] = "estimate"
    substeps: Annotated[int, Meta(ge=1)] | None = None
    seed: Annotated[int, Meta(ge=0)] = 0
    jobs: Annotated[int, Meta(ge=1)] = 2
    out: str | None = None
    picture: bool = True


@dataclass(frozen=True)
class Identification:
    """All that a fit needs."""

    options: IdentifyOptions
    #: With its effects, before any of its states was prescribed: what is written in the end
    model: Model
    problem: FitProblem
    method: Method
    recordings: tuple[Dataset, ...]  #: Whole, as they were loaded, driven as the problem's
    idle: tuple[str, ...] = ()  #: Parameters that were asked for and have no part in the equations
    #: What was found in the recordings
    admission: Admission = field(default_factory=lambda: Admission(()))

    @property
    def driven(self) -> tuple[str, ...]:
        """States that measurements prescribe."""
        return several(self.options.driven, "driven")


def identification_of(composition: Composition) -> Identification:
    """Build what a configuration asks for.

    Raises TrmsError for the first key, recording or parameter that is wrong.
    """
    config = composition.config
    options = _options(config)
    method = build(config["method"], "method")
    if not isinstance(method, Method):
        raise ConfigurationError(
            f"{config['method'][TARGET]!r} cannot fit",
            where="method",
            remedy="a method is a frozen dataclass with fits_parameters and fit(problem, "
            "progress); see `trms list method`",
        )
    model = model_of(config)
    data = build(config["data"], "data")
    driven = several(options.driven, "driven")
    if not method.fits_parameters:
        _refuse_for_networks(options, driven)
    simulated = driven_model(model, driven)
    free, idle = _free(simulated, options, method)
    loaded = load_datasets(several(options.real, "real"), model, data)
    admission = admit(loaded, model, len(free))
    admission.require()
    recordings = driven_recordings(loaded, driven)
    fitted, held_out = _parts(recordings, options, model, data, driven)
    problem = FitProblem(
        model=simulated,
        datasets=fitted,
        validation=held_out,
        free=free,
        window_length=options.windows.length,
        window_stride=options.windows.stride,
        robust=options.robust,
        discrepancy=options.discrepancy,
        substeps=options.substeps,
        seed=options.seed,
        jobs=options.jobs,
    )
    return Identification(options, model, problem, method, recordings, idle, admission)


def _options(config: Mapping[str, Any]) -> IdentifyOptions:
    own = {key: value for key, value in config.items() if key not in _GROUPS}
    options = build({TARGET: f"{__name__}.IdentifyOptions", **own})
    assert isinstance(options, IdentifyOptions)
    return options


def _parts(
    recordings: tuple[Dataset, ...],
    options: IdentifyOptions,
    model: Model,
    data: DataOptions,
    driven: Sequence[str],
) -> tuple[tuple[Dataset, ...], tuple[Dataset, ...]]:
    """What is fitted, and what is kept from the fit."""
    keep = options.validation
    if keep.real is not None:
        try:
            loaded = load_datasets(several(keep.real, "validation.real"), model, data)
        except TrmsError as error:
            if error.where == "real":
                error.where = "validation.real"
            raise
        held_out = driven_recordings(loaded, driven)
        twice = {d.sha256 for d in recordings} & {d.sha256 for d in held_out}
        if twice:
            source = next(d.source for d in held_out if d.sha256 in twice)
            raise ConfigurationError(
                f"{source} is fitted as well",
                where="validation.real",
                remedy="hold out another recording, or a part of each by validation.share",
            )
        return recordings, held_out
    if keep.share == 0:
        return recordings, ()
    fitted, held = zip(*(dataset.split(1.0 - keep.share) for dataset in recordings), strict=True)
    for dataset in fitted:
        if len(dataset) < _FEWEST_SAMPLES:
            raise ConfigurationError(
                f"{len(dataset)} samples of {dataset.source} are left to be fitted",
                where="validation.share",
                remedy="hold out less, or record longer",
            )
    return fitted, tuple(dataset for dataset in held if len(dataset) >= _FEWEST_SAMPLES)


def _refuse_for_networks(options: IdentifyOptions, driven: Sequence[str]) -> None:
    """Refuse what only a fit of equations can heed: a training would drop it without a word."""
    asked = {
        "driven": driven,
        "free": several(options.free, "free") not in (("priors",), ["priors"]),
        "priors": options.priors,
        "bounds": options.bounds,
    }
    for key, given in asked.items():
        if given:
            raise ConfigurationError(
                f"a network has no parameters of a model, and {key} is given",
                where=key,
                remedy=f"leave {key} out, or fit a model: method=multiple_shooting",
            )


def _free(
    model: Model, options: IdentifyOptions, method: Method
) -> tuple[tuple[FreeParameter, ...], tuple[str, ...]]:
    """The free parameters, none for a method that trains a network of its own; and idle ones."""
    if not method.fits_parameters:
        return (), ()
    priors = {
        name: None if node is None else _prior(name, node)
        for name, node in _flat(options.priors, _is_prior)
    }
    bounds = {name: _bounds(name, node) for name, node in _flat(options.bounds, _is_leaf)}
    words = several(options.free, "free")
    found = free_parameters(model.parameters, words, priors=priors, bounds=bounds)
    used = acting_parameters(model)
    idle = tuple(parameter.name for parameter in found if parameter.name not in used)
    for name in idle:
        if name in words:
            raise ConfigurationError(
                f"{name!r} has no part in the equations of this model",
                where="free",
                remedy="leave it out; of those that have a prior these act: "
                + ", ".join(p.name for p in model.parameters if p.prior_sd and p.name in used),
            )
    return tuple(parameter for parameter in found if parameter.name in used), idle


def _flat(node: Mapping[str, Any], is_leaf: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in node.items():
        if is_leaf(value):
            yield f"{prefix}{name}", value
        else:
            yield from _flat(value, is_leaf, f"{prefix}{name}.")


def _is_leaf(value: Any) -> bool:
    return not isinstance(value, Mapping)


def _is_prior(value: Any) -> bool:
    return not isinstance(value, Mapping) or not value or bool(_PRIOR_KEYS & set(value))


def _prior(name: str, node: Any) -> Prior:
    where = f"priors.{name}"
    if not isinstance(node, Mapping):
        raise ConfigurationError(
            f"{node!r} given",
            where=where,
            remedy=f"in quotes: '{where}={{mean: …, sd: …}}', or {{relative_sd: …}}, or null",
        )
    prior = build({TARGET: "trms_cli.identification.problem.Prior", **node}, where)
    assert isinstance(prior, Prior)
    return prior


def _bounds(name: str, node: Any) -> tuple[float | None, float | None]:
    try:
        return msgspec.convert(node, tuple[float | None, float | None])
    except msgspec.ValidationError:
        raise ConfigurationError(
            f"{node!r} given",
            where=f"bounds.{name}",
            remedy="[lower, upper], null for none on that side",
        ) from None
