"""A fit: problem, result, figures as ``trms.identification/1``, findings, files."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from trms_cli.composition.composer import Composition
from trms_cli.composition.plain_values import model_of_choice
from trms_cli.core import wording
from trms_cli.core.errors import EXIT_OK, ConfigurationError, SimulationError, TrmsError
from trms_cli.core.findings import NextCommand, json_data
from trms_cli.core.invocation import command_line, program
from trms_cli.core.plugins import TARGET, build, construct
from trms_cli.core.versions import versions
from trms_cli.identification import free_runs
from trms_cli.identification.admission.admit import admit
from trms_cli.identification.admission.issues import Admission
from trms_cli.identification.data import DataOptions, load_datasets
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.findings import findings, in_short
from trms_cli.identification.model_writer import ModelOrigin, model_document, write_model
from trms_cli.identification.problem import FitOutcome as Ended
from trms_cli.identification.problem import (
    FitProblem,
    FitResult,
    FreeParameter,
    Method,
    Prior,
    acting_parameters,
    free_parameters,
)
from trms_cli.library.tasks import files
from trms_cli.library.tasks.control_advice import control_commands
from trms_cli.library.tasks.subject import driven_model, driven_recordings, model_of, several
from trms_cli.library.tasks.task import Done, Listener
from trms_cli.models.model import Model, names
from trms_cli.models.scales import longest_run

#: Keys of the configuration that are plugins of their own.
_GROUPS = ("model", "effect", "method", "data", "experiment")
_Positive = Annotated[float, Meta(gt=0)]
_PRIOR_KEYS = {"mean", "sd", "relative_sd"}
#: Fewer samples than this cannot be fitted or judged.
_FEWEST_SAMPLES = 20


@dataclass(frozen=True, kw_only=True)
class WindowKeys:
    """``windows``."""

    length: _Positive = 10.0  #: s, at most: shorter for a model that falls over
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
    own = {key: value for key, value in config.items() if key not in _GROUPS}
    options = construct(IdentifyOptions, own)
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
        _refuse_for_black_boxes(options, driven)
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
        window_length=min(options.windows.length, longest_run(simulated)),
        window_stride=options.windows.stride,
        robust=options.robust,
        discrepancy=options.discrepancy,
        substeps=options.substeps,
        seed=options.seed,
        jobs=options.jobs,
    )
    return Identification(options, model, problem, method, recordings, idle, admission)


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
    fitted, validation_parts = zip(
        *(dataset.split(1.0 - keep.share) for dataset in recordings), strict=True
    )
    for dataset in fitted:
        if len(dataset) < _FEWEST_SAMPLES:
            raise ConfigurationError(
                f"{len(dataset)} samples of {dataset.source} are left to be fitted",
                where="validation.share",
                remedy="hold out less, or record longer",
            )
    return fitted, tuple(dataset for dataset in validation_parts if len(dataset) >= _FEWEST_SAMPLES)


def _refuse_for_black_boxes(options: IdentifyOptions, driven: Sequence[str]) -> None:
    """Refuse what only a fit of equations can heed: a black box would drop it without a word."""
    settings = {
        "driven": driven,
        "free": several(options.free, "free") not in (("priors",), ["priors"]),
        "priors": options.priors,
        "bounds": options.bounds,
    }
    for key, value in settings.items():
        if value:
            raise ConfigurationError(
                f"a black box has no parameters of a model, and {key} is given",
                where=key,
                remedy=f"leave {key} out, or fit a model: method=multiple_shooting",
            )


def _free(
    model: Model, options: IdentifyOptions, method: Method
) -> tuple[tuple[FreeParameter, ...], tuple[str, ...]]:
    """The free parameters, none for a method that makes a black box of its own; and idle ones."""
    if not method.fits_parameters:
        return (), ()
    priors = {
        name: None if node is None else _prior(name, node)
        for name, node in _flat(options.priors, _is_prior)
    }
    bounds = {name: _bounds(name, node) for name, node in _flat(options.bounds, _is_leaf)}
    words = several(options.free, "free")
    candidates = free_parameters(model.parameters, words, priors=priors, bounds=bounds)
    used = acting_parameters(model)
    idle = tuple(parameter.name for parameter in candidates if parameter.name not in used)
    for name in idle:
        if name in words:
            raise ConfigurationError(
                f"{name!r} has no part in the equations of this model",
                where="free",
                remedy="leave it out; of those that have a prior these act: "
                + ", ".join(p.name for p in model.parameters if p.prior_sd and p.name in used),
            )
    return tuple(parameter for parameter in candidates if parameter.name in used), idle


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
    return construct(Prior, node, where)


def _bounds(name: str, node: Any) -> tuple[float | None, float | None]:
    try:
        return msgspec.convert(node, tuple[float | None, float | None])
    except msgspec.ValidationError:
        raise ConfigurationError(
            f"{node!r} given",
            where=f"bounds.{name}",
            remedy="[lower, upper], null for none on that side",
        ) from None


SCHEMA = "trms.identification/1"
#: Files of a fit in its folder.
MODEL_NAME, DOCUMENT_NAME, PAGE_NAME = "model.yaml", "identification.json", "identification.html"


def perform(composition: Composition, listener: Listener, folder: Path | None = None) -> Done:
    """Fit what a configuration asks for; in the folder of an earlier fit, go on with that.

    Raises KeyboardInterrupt in a sweep if it was stopped: the sweep ends too.
    """
    begin = perf_counter()
    from trms_cli.reporting.progress import STATE_NAME, FitProgress
    from trms_cli.runs.run_folder import write_document

    request = identification_of(composition)
    origin = files.origin_of(composition) if request.problem.free else None
    again = folder is not None
    folder = folder or composition.folder("identify")
    if not again:
        files.write_config(composition, folder)
    listener.begin(_words(composition, request), dict(_facts(request)))
    progress = FitProgress(folder / STATE_NAME, resume=again, quiet=listener.quiet)
    with progress:
        result = request.method.fit(request.problem, progress)
    if again:  # now that it is known to be the same search
        files.write_config(composition, folder)
    if result.outcome is Ended.FAILED:  # it could simulate nothing: there is no model to write
        problem, _, remedy = result.outcome.value.partition(": ")
        raise SimulationError(problem, where="model", remedy=remedy)
    fitted = free_runs.assess(request.problem, result)
    model = write_fitted_model(
        request, fitted.result, fitted.deviations, origin, folder / MODEL_NAME
    )
    free_runs.add_free_runs(request.problem, fitted, black_box_of(result, model))
    document = document_of(composition, request, fitted, perf_counter() - begin)
    written = {"model": model, "numbers": folder / DOCUMENT_NAME}
    write_document(document, written["numbers"])
    then = _next(composition, request, document, folder)
    summary = findings(document, fitted, then)
    if composition.config["picture"]:
        from trms_cli.reporting.page import write_page

        page = write_page(summary, folder / PAGE_NAME, interactive=False)
        written |= {"page": page} if page else {}
    if progress.exit_code is not None and composition.job is not None:
        raise KeyboardInterrupt
    spent = {
        "fit": f"{wording.count(result.evaluations, 'simulation')} in "
        f"{wording.seconds(result.seconds)}, cost {result.cost:.6g}",
        "time": f"{wording.seconds(perf_counter() - begin)} in all",
    }
    code = EXIT_OK if progress.exit_code is None else progress.exit_code
    summary = replace(summary, facts=spent, files=written, warnings=())
    if composition.job is not None:
        summary = replace(summary, lead=[in_short(document)])
    return Done(folder, summary, exit_code=code, objective=result.cost)


def write_fitted_model(
    request: Identification,
    result: FitResult,
    deviations: Mapping[str, float | None],
    origin: ModelOrigin | None,
    path: Path,
) -> Path:
    """Write the fitted model."""
    driven = f", driven by the measured {', '.join(request.driven)}" if request.driven else ""
    source = f"fitted to {files.names_of_files(request.problem.datasets)}{driven}"
    if result.model_document is not None:
        document = dict(result.model_document)
        document.setdefault("source", source)
    else:
        assert origin is not None
        model = request.model if result.remodel is None else result.remodel(request.model)
        document = model_document(
            request.recordings[0].name,
            model,
            origin,
            values=result.values,
            deviations=deviations,
            free=request.problem.free,
            source=source,
        )
    heading = (
        f"{command_line()}\n"
        f"{result.outcome.value}; sd: standard deviation of a fitted value, "
        "prior_sd: of what was known before, relative"
    )
    write_model(document, path, heading)
    return path


def black_box_of(result: FitResult, file: Path) -> Model | None:
    """The black box that a method made, as its file says; None for fitted parameters."""
    if result.model_document is None:
        return None
    from trms_cli.effects.model_file import load_model

    return load_model(str(file))


def _words(composition: Composition, request: Identification) -> str:
    choices = composition.choices
    model = wording.model_name(model_of_choice(composition))
    words = [str(choices.get("method")), f"model {model}"]
    if choices.get("effect"):
        words.append(f"effect {', '.join(choices['effect'])}")
    if request.driven:
        words.append(f"driven by {', '.join(request.driven)}")
    if request.problem.free:
        words.append(f"{wording.count(len(request.problem.free), 'parameter')} free")
    return " · ".join(words)


def _facts(request: Identification) -> Iterator[tuple[str, str]]:
    problem = request.problem
    yield "fitted", "; ".join(map(_part, problem.datasets))
    if problem.validation:
        yield "held out", "; ".join(map(_part, problem.validation))
    else:
        yield "held out", "nothing: how good the model is on other data stays unknown"
    remarks: dict[str, None] = {}
    for dataset in (*problem.datasets, *problem.validation):
        remarks |= dict.fromkeys(dataset.remarks)
    if request.idle:
        remarks[f"no part in the equations, so not fitted: {', '.join(request.idle)}"] = None
    if remarks:
        yield "note", "\n".join(remarks)
    if request.admission.warnings:
        yield "warning", "\n".join(map(str, request.admission.warnings))


def _part(dataset: Dataset) -> str:
    return (
        f"{dataset.name} {dataset.time[0]:g} to {dataset.time[-1] + dataset.sample_time:g} s "
        f"at {1 / dataset.sample_time:g} Hz"
    )


def _next(
    composition: Composition, request: Identification, document: Mapping[str, Any], folder: Path
) -> list[NextCommand]:
    from trms_cli.reporting.progress import STATE_NAME

    model = shlex.quote(str(folder / MODEL_NAME))
    commands = [
        NextCommand(f"{program()} validate model={model} {_judging(composition, request)}"),
        *control_commands(
            request.model,
            folder / MODEL_NAME,
            [recording.source for recording in request.recordings],
            composition,
            kind="fitted",
        ),
    ]
    if document["outcome"] in ("interrupted", "budget_spent") and (folder / STATE_NAME).is_file():
        line = f"{program()} identify resume={shlex.quote(str(folder))}"
        longer = _more(composition.config["method"])
        budget = document["outcome"] == "budget_spent"
        commands.append(NextCommand(f"{line} {longer}" if longer and budget else line))
    return commands


def _judging(composition: Composition, request: Identification) -> str:
    """The recording, read as the fit read it, and of it what was held out."""
    first = (*request.problem.validation, *request.recordings)[0]
    words = [f"real={shlex.quote(first.source)}"]
    if request.driven:
        words.append(f"driven=[{','.join(request.driven)}]")
    words += [shlex.quote(w) for w in composition.overrides if w.startswith("data.")]
    parted = request.problem.validation and first.source == request.recordings[0].source
    if parted and not any(w.startswith("data.start=") for w in words):
        words.append(f"data.start={first.time[0]:g}")
    return " ".join(words)


def _more(method: Mapping[str, Any]) -> str:
    for key in ("generations", "evaluations", "iterations"):
        if isinstance(method.get(key), int):
            return f"method.{key}={2 * method[key]}"
    return ""


def document_of(
    composition: Composition, request: Identification, fitted: free_runs.Assessment, seconds: float
) -> dict[str, Any]:
    """The document of a command that took `seconds`; figures that do not exist are null."""
    result, problem, matrix = fitted.result, request.problem, fitted.correlation
    content = {
        "schema": SCHEMA,
        "command": command_line(),
        "versions": versions(),
        "model": model_of_choice(composition),
        "effects": list(composition.config.get("effect") or {}),
        "method": composition.choices.get("method"),
        "settings": dict(composition.config["method"]),
        "driven": list(request.driven),
        "windows": {"length_s": problem.window_length, "stride_s": problem.window_stride},
        "seed": problem.seed,
        "recordings": [
            *(_recording(d, "fit") for d in problem.datasets),
            *(_recording(d, "held_out") for d in problem.validation),
        ],
        "admission": request.admission.as_data(),
        "outcome": result.outcome.name.lower(),
        "sentence": result.outcome.value,
        "settled": result.outcome.settled,
        "cost": result.cost,
        "evaluations": result.evaluations,
        "seconds": {"fit": result.seconds, "whole": seconds},
        "history": [list(point) for point in result.history],
        "parameters": _parameters(request.problem, fitted),
        "correlation": None if matrix is None else {"names": list(result.values), "matrix": matrix},
        **fitted.statistics,
        "errors": {
            part: {
                "before": _errors(fitted.before.get(part)),
                "after": _errors(fitted.after.get(part)),
            }
            for part in ("fit", "held_out")
        },
        "details": dict(result.details),
    }
    plain: dict[str, Any] = json_data(content)
    return plain


def _recording(dataset: Dataset, part: str) -> dict[str, Any]:
    return {
        "name": dataset.name,
        "source": dataset.source,
        "sha256": dataset.sha256,
        "part": part,
        "from_s": float(dataset.time[0]),
        "to_s": float(dataset.time[-1]),
        "samples": len(dataset),
        "sample_time_s": dataset.sample_time,
        "inputs": list(names(dataset.inputs)),
        "outputs": list(names(dataset.outputs)),
        "noise_sd": dict(zip(names(dataset.outputs), dataset.noise_sd.tolist(), strict=True)),
        "remarks": list(dataset.remarks),
    }


def _parameters(problem: FitProblem, fitted: free_runs.Assessment) -> dict[str, Any]:
    values = fitted.result.values
    bounds = free_runs.at_bounds(problem, values) if values else {}
    return {
        p.name: {
            "value": values[p.name],
            "sd": fitted.deviations[p.name],
            "unit": p.unit,
            "start": p.start,
            "prior_mean": p.prior_mean,
            "prior_sd": p.prior_sd,
            "lower": p.lower,
            "upper": p.upper,
            "at_bound": bounds.get(p.name),
        }
        for p in problem.free
        if p.name in values
    }


def _errors(runs: Sequence[free_runs.WindowRuns] | None) -> dict[str, Any] | None:
    return free_runs.error_figures(runs) if runs else None
