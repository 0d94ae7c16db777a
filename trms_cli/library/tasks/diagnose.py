"""A diagnosis: problem, result, findings, files."""

from __future__ import annotations

import fnmatch
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, Literal

from msgspec import Meta

from trms_cli.composition.catalogue import read_groups, read_yaml
from trms_cli.composition.composer import Composition
from trms_cli.composition.laws import at_own_port, generated_nodes
from trms_cli.composition.plain_values import model_of_choice
from trms_cli.core import wording
from trms_cli.core.errors import (
    EXIT_TERMINATED,
    ConfigurationError,
    ModelError,
    RecordingError,
    TrmsError,
)
from trms_cli.core.findings import Chart, Findings, RigDiagram
from trms_cli.core.invocation import command_line, program
from trms_cli.core.plugins import TARGET, build, construct, nearest
from trms_cli.core.versions import versions
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import ExtendedModel, effect_names, extend_model
from trms_cli.effects.model_form import MODEL_FORM
from trms_cli.gap.belief import calibration_file, simulated_part
from trms_cli.gap.diagnosis import (
    NO_EFFECT,
    Cause,
    ControlCommand,
    DiagnosisResult,
    NextExperiment,
    Worth,
    compared_with_a_state,
    likeliest,
)
from trms_cli.gap.problem import GapProblem
from trms_cli.identification.admission.admit import admit
from trms_cli.identification.admission.issues import Admission
from trms_cli.identification.data import DataOptions, load_datasets
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.model_writer import ModelOrigin, model_document, write_model
from trms_cli.identification.problem import free_parameters
from trms_cli.library.tasks.control_advice import (
    CONTROLLER,
    control_commands,
    on_recorded_rig,
    own_options,
)
from trms_cli.library.tasks.files import effect_arguments, names_of_files, origin_of, write_config
from trms_cli.library.tasks.subject import model_of, several
from trms_cli.library.tasks.task import Done, Interrupted, Listener
from trms_cli.models.model import Model, names

if TYPE_CHECKING:
    from trms_cli.simulation.closed_loop import Experiment

#: Keys of the configuration that are plugins of their own.
_GROUPS = ("model", "effect", "data")
#: Checks of an admission that hold a recording against the model.
_BY_MODEL = {"unit", "sign", "swapped", "speed", "zero", "sample time"}
#: Blocks that a recording must hold: some to fit, some to choose by, one that is sealed.
_FEWEST_BLOCKS = 4
#: s. Blocks of a recording that is long enough, and those that are too short to show anything.
_USUAL_BLOCK, _SHORTEST_BLOCK = 10.0, 5.0
#: Samples that a block must hold to be worth one.
_FEWEST_SAMPLES = 20


@dataclass(frozen=True, kw_only=True)
class DiagnoseOptions:
    """The keys of ``configs/diagnose.yaml`` that are no group."""

    real: str | tuple[str, ...]
    against: str | tuple[str, ...] | None = None  #: of the same rig in a known state
    candidates: str | tuple[str, ...] = ("all",)
    effort: Literal["quick", "normal", "thorough"] = "normal"
    block: Annotated[float, Meta(gt=0)] | None = None  #: s
    sealed_share: Annotated[float, Meta(gt=0, lt=1)] = 0.25  #: kept aside for the verdict
    calibration: str | None = None  #: File; None: the model's own in a folder of options, if any
    seed: Annotated[int, Meta(ge=0)] = 0
    jobs: Annotated[int, Meta(ge=1)] = 2
    out: str | None = None
    page: bool = True
    advise: bool = True  #: Look for the next experiment, and drive the loop with the correction

    @property
    def advises(self) -> bool:
        """Whether it is asked for; a quick diagnosis does without."""
        return self.advise and self.effort != "quick"


@dataclass(frozen=True)
class DiagnosisRequest:
    """All that a diagnosis needs."""

    options: DiagnoseOptions
    problem: GapProblem
    candidates: Candidates
    remarks: tuple[str, ...]  #: What was found in the recordings and what was done to them

    @property
    def fingerprint(self) -> str:
        """Of all that the result depends on, hexadecimal."""
        problem = self.problem
        parts = [
            problem.model_name,
            *(f"{p.name} {p.value!r} {p.prior_sd!r}" for p in problem.model.parameters),
            repr(self.candidates.nodes),
            repr((problem.block, problem.sealed_share, problem.effort, problem.seed)),
            repr((problem.calibration, sorted(problem.quanta.items()))),
        ]
        digest = sha256("\n".join(parts).encode())
        for dataset in (*problem.datasets, *problem.against):
            for values in (dataset.time, dataset.commands, dataset.measurements, dataset.noise_sd):
                digest.update(values.tobytes())
        return digest.hexdigest()


def request_of(composition: Composition) -> DiagnosisRequest:
    """Build what a configuration asks for.

    Raises TrmsError for the first key, recording or effect that is wrong.
    """
    config = composition.config
    keys = {key: value for key, value in config.items() if key not in _GROUPS}
    options = construct(DiagnoseOptions, keys)
    data = build(config["data"], "data")
    assert isinstance(data, DataOptions)
    model = model_of(config)
    _require_equations(model)
    own = _calibration(options, model, composition.config_dirs)
    calibration = None if own is None else calibration_file(own)
    words = several(options.candidates, "candidates")
    candidates = candidates_of(words, model, composition.config_dirs)
    datasets = tuple(load_datasets(several(options.real, "real"), model, data))
    with_prior = sum(p.prior_sd is not None for p in model.parameters)
    admission = admit(datasets, model, with_prior)
    _require(admission, model_of_choice(composition))
    against = _against(options, datasets, model, data, model_of_choice(composition))
    _require_one_rate((*datasets, *against))
    if not against:
        _require_blocks(datasets, options)
    problem = GapProblem(
        model=model,
        model_name=model_of_choice(composition),
        datasets=datasets,
        candidates=candidates.effects,
        against=against,
        block=_block(datasets, options),
        sealed_share=options.sealed_share,
        effort=options.effort,
        seed=options.seed,
        jobs=options.jobs,
        advise=options.advises,
        quanta=data.quantum or {},
        calibration=calibration,
        warnings=tuple(str(issue) for issue in admission.warnings),
    )
    everything = (*datasets, *against)
    remarks = dict.fromkeys(remark for dataset in everything for remark in dataset.remarks)
    if own is not None:
        remarks[f"probabilities by the weights in {own}"] = None
    return DiagnosisRequest(options, problem, candidates, tuple(remarks))


#: Folder of options with the calibrations of models.
_CALIBRATION = "calibration"


def _calibration(
    options: DiagnoseOptions, model: Model, config_dirs: Sequence[Path]
) -> Path | None:
    """The file that is asked for, or the model's own; None: the package's."""
    if options.calibration is not None:
        return Path(options.calibration).expanduser()
    files = (folder / _CALIBRATION / f"{model.name}.json" for folder in config_dirs)
    return next((file for file in files if file.is_file()), None)


#: s. Recordings of a known state, together, and those in question must be as long.
_SHORTEST_COMPARED = 10.0


def _against(
    options: DiagnoseOptions,
    datasets: Sequence[Dataset],
    model: Model,
    data: DataOptions,
    name: str,
) -> tuple[Dataset, ...]:
    """Recordings of the known state, none where none are given.

    Raises ConfigurationError for those that do not compare with the ones in question.
    """
    if options.against is None:
        return ()
    reference_datasets = tuple(load_datasets(several(options.against, "against"), model, data))
    _require(
        admit(reference_datasets, model, sum(p.prior_sd is not None for p in model.parameters)),
        name,
    )
    both = {d.sha256: d for d in datasets}
    for dataset in reference_datasets:
        if dataset.sha256 in both:
            raise ConfigurationError(
                f"{dataset.source} is among the recordings in question, too",
                where="against",
                remedy="real= takes what is in question, against= what is known to be in order",
            )
        for other in datasets:
            one, two = (names(d.outputs) for d in (dataset, other))
            if set(one) != set(two):
                raise ConfigurationError(
                    f"{dataset.source} measures {', '.join(one)}, and {other.source} "
                    f"{', '.join(two)}",
                    where="against",
                    remedy="compare what both measure: "
                    f"data.channels=[{','.join(n for n in one if n in two)}]",
                )
    for where, recordings in (("against", reference_datasets), ("real", datasets)):
        length = sum(d.duration for d in recordings)
        if length < _SHORTEST_COMPARED:
            raise ConfigurationError(
                f"{length:.3g} s recorded are too short to compare",
                where=where,
                remedy=f"give at least {_SHORTEST_COMPARED:g} s, better 60 s",
            )
    return reference_datasets


def _require(admission: Admission, model: str) -> None:
    """Refuse what makes every answer wrong; what does not fit a model may be of another rig."""
    try:
        admission.require()
    except RecordingError as error:
        if {issue.check for issue in admission.errors} & _BY_MODEL:
            error.remedy += f"\nif the file is right: is {model} the model of this rig?"
        raise


def _require_equations(model: Model) -> None:
    """A network steps from sample to sample: nothing in it is a place where a force could miss."""
    if model.sample_time is not None:
        raise ConfigurationError(
            f"model {model.name!r} only steps from sample to sample: a gap has no place in it",
            where="model",
            remedy="diagnose a model with equations of motion, as newtonian; `trms validate` tells "
            "how good a network is",
        )


def _require_one_rate(datasets: tuple[Dataset, ...]) -> None:
    steps = sorted({round(d.sample_time, 9) for d in datasets})
    if len(steps) > 1:
        raise ConfigurationError(
            f"the recordings have sample times of {', '.join(f'{s:g}' for s in steps)} s",
            where="real",
            remedy=f"bring them to one: data.resample={steps[-1]:g}",
        )


def _block(datasets: Sequence[Dataset], options: DiagnoseOptions) -> float:
    """Length of the blocks, s; as asked for, or such that a short recording has enough of them."""
    if options.block is not None:
        return options.block
    length = sum(dataset.duration for dataset in datasets)
    return max(_SHORTEST_BLOCK, min(_USUAL_BLOCK, length / (_FEWEST_BLOCKS + 1)))


def _require_blocks(datasets: tuple[Dataset, ...], options: DiagnoseOptions) -> None:
    """Some blocks to fit, some to choose by, and one at least that is sealed."""
    step = datasets[0].sample_time
    block = _block(datasets, options)
    if block < _FEWEST_SAMPLES * step:
        raise ConfigurationError(
            f"a block of {block:g} s holds {block / step:.0f} samples",
            where="block",
            remedy=f"give at least {_FEWEST_SAMPLES * step:g} s; 5 to 15 s suit most rigs",
        )
    whole = sum(int(d.duration / block + 1e-6) for d in datasets)
    if whole < _FEWEST_BLOCKS:
        length = sum(d.duration for d in datasets)
        raise ConfigurationError(
            f"{length:g} s recorded hold {whole} blocks of {block:g} s, and "
            f"{_FEWEST_BLOCKS} are needed: to fit, to choose by, and to be sealed",
            where="real",
            remedy=f"record at least {_FEWEST_BLOCKS * block:g} s, better 120 s"
            + (
                f"; or shorter blocks: block={length / _FEWEST_BLOCKS:.3g}"
                if length / _FEWEST_BLOCKS >= max(5.0, _FEWEST_SAMPLES * step)
                else ""
            ),
        )


#: The group of the effects, and the word for all of them.
_GROUP, _ALL = "effect", "all"


@dataclass(frozen=True)
class Candidates:
    """Effects that may be the cause."""

    effects: Mapping[str, Effect]  #: At the sizes of their options
    nodes: Mapping[str, Mapping[str, Any]]  #: What the options say: class and arguments


def candidates_of(
    words: Sequence[str], model: Model, config_dirs: Sequence[Path] = ()
) -> Candidates:
    """The effects that ``candidates`` names, as far as the model can carry them.

    ``words``: ``all``, names, patterns, and any of these after ``!`` to leave out again. ``model``:
    the nominal one; an effect that it has already is no candidate. ``config_dirs``: the user's
    folders; an option there hides a built-in namesake.

    Raises ConfigurationError for a name or pattern that fits nothing, an option that is no effect,
    or a list that leaves nothing, and ModelError for an effect that is asked for by its name and
    that the model cannot carry.
    """
    library = effect_nodes(config_dirs)
    generated = dict(generated_nodes(model, read_groups(config_dirs)))
    if model.bench_sizes:  # the library is its own; others are generated where they are named
        generated = {name: node for name, node in generated.items() if name in words}
    library = generated | library
    effects: dict[str, Effect] = {}
    left_out: dict[str, str] = {}
    present = effect_names(model)
    for name in _select_names(words, library):
        if name in present:
            left_out[name] = "the nominal model has it already"
            continue
        effect = build(library[name], f"{_GROUP}.{name}")
        if not isinstance(effect, Effect):
            raise ConfigurationError(
                f"{library[name][TARGET]!r} is no effect",
                where=f"{_GROUP}.{name}",
                remedy=f"derive it from trms_cli.effects.effect.Effect, or leave it out: !{name}",
            )
        if not effect.explains and name not in words:
            continue
        try:
            effect = ExtendedModel(model, name, effect).effect
        except ModelError as error:
            if name in words:
                raise
            if name not in generated:  # most laws fit few ports: that goes without saying
                left_out[name] = error.problem
            continue
        if name in generated and name not in words and not at_own_port(name, effect, model):
            continue  # a sensor of an axis goes by its output's name
        effects[name] = effect
    if not effects:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise ConfigurationError(
            "no effect is left as a candidate" + (f" ({reasons})" if reasons else ""),
            where="candidates",
            remedy="candidates=[all], or names that `trms list effect` shows",
        )
    return Candidates(effects, {name: library[name] for name in effects})


def effect_nodes(config_dirs: Sequence[Path] = ()) -> dict[str, dict[str, Any]]:
    """All effects in the search path, by the name under which a model gains them."""
    nodes: dict[str, dict[str, Any]] = {}
    for option in read_groups(config_dirs).get(_GROUP, {}).values():
        content = read_yaml(option.file)
        for name, node in content.items() if isinstance(content, dict) else ():
            if isinstance(node, dict) and TARGET in node:
                nodes.setdefault(str(name), node)
    return dict(sorted(nodes.items()))


def _select_names(words: Sequence[str], library: Mapping[str, Any]) -> list[str]:
    """Names in the order of the library."""
    selection: set[str] = set()
    if words and all(word.startswith("!") for word in words):
        selection = set(library)  # `all` goes without saying
    for word in words:
        if word.startswith("!"):
            selection -= _fitting(word[1:], library)
        else:
            selection |= _fitting(word, library)
    return [name for name in library if name in selection]


def _fitting(word: str, library: Mapping[str, Any]) -> set[str]:
    if word == _ALL:
        return set(library)
    matches = {name for name in library if fnmatch.fnmatchcase(name, word)}
    if not matches:
        raise ConfigurationError(
            f"no effect is called {word!r}",
            where="candidates",
            remedy=nearest(word, [_ALL, *library]),
        )
    return matches


CORRECTED_NAME, REFIT_NAME = "corrected_model.yaml", "refit_model.yaml"


def write_models(
    request: DiagnosisRequest, origin: ModelOrigin, diagnosis: DiagnosisResult, folder: Path
) -> Path:
    """Write the corrected model, whose file is returned, and the refitted one without a cause."""
    cause, residual = applied_cause(diagnosis), diagnosis.residual
    fitted = {name: p.fitted for name, p in diagnosis.parameters.items()}
    deviations: dict[str, float | None] = {n: p.sd for n, p in diagnosis.parameters.items()}
    if diagnosis.verdict == "no_gap":
        refit, words = {}, "the nominal model: there is no gap, so nothing was refitted"
    else:
        refit = dict(diagnosis.refit) or ({} if cause is not None or residual else fitted)
        words = f"{_refitted(diagnosis)}, and nothing added"
    corrected = folder / CORRECTED_NAME
    plain = cause is None and not residual
    values = {} if diagnosis.verdict == "no_gap" else fitted or refit
    _write(
        request, origin, cause, values, deviations, corrected, corrected_words(diagnosis), residual
    )
    spread = deviations if plain else {}
    _write(request, origin, None, refit, spread, folder / REFIT_NAME, words)
    return corrected


def applied_cause(diagnosis: DiagnosisResult) -> Cause | None:
    """The cause that the corrected model has, and that the figures of the sealed part are of.

    The likeliest, where it is an effect that was fitted: a torque from outside is estimated, not
    simulated, and has no sizes.
    """
    first = likeliest(diagnosis)
    if first is None or not first.parameters or set(first.effects) & set(NO_EFFECT):
        return None
    if diagnosis.verdict not in ("effect", "undecided"):
        return None
    if first.onset is not None and first.onset.ends:
        return None  # the rig is without it now
    # a torque from outside or a coarse sensor beside it is no part of a model
    fitted = tuple(
        name
        for name in simulated_part(first.effects)
        if any(size.startswith(f"{name}.") for size in first.parameters)
    )
    return replace(first, effects=fitted) if fitted else None


def _refitted(diagnosis: DiagnosisResult) -> str:
    also = " and the form of its laws" if diagnosis.model_form else ""
    return f"the nominal model with its parameters{also} refitted"


def corrected_words(diagnosis: DiagnosisResult) -> str:
    """What the corrected model is, for the comment in its file."""
    applied, first = applied_cause(diagnosis), likeliest(diagnosis)
    refit = _refitted(diagnosis)
    if applied is not None:
        named = f"{' with '.join(applied.effects)} (p = {applied.probability:.2f})"
        open_ = "; undecided: this is the likeliest cause" if diagnosis.verdict != "effect" else ""
        if applied.onset and not diagnosis.against:
            part, when = (
                ("the beginning of the recordings", "later")
                if compared_with_a_state(diagnosis)
                else ("the recordings", "in them")
            )
            return f"the nominal model fitted to {part} with {named}, which begins {when}"
        fit_words = "fitted to the known state" if diagnosis.against else "refitted together"
        return f"the nominal model {fit_words} with {named}{open_}"
    if diagnosis.against and diagnosis.residual:
        named = " with ".join(diagnosis.residual)
        return f"the model fitted to the known state with {named}, which stands in for what pulls"
    if first is not None and first.onset is not None and first.onset.ends:
        return f"the model fitted to the end of the recordings, when {first.effects[0]} had ended"
    if diagnosis.verdict == "effect" and first is not None:
        return f"{refit}: {' with '.join(first.effects)} was not fitted, so it is not added"
    if diagnosis.residual:
        named = " with ".join(diagnosis.residual)
        return f"{refit}; no effect of the library explains the gap: {named} stands in for a law"
    return {
        "no_gap": "the nominal model as it was: no gap was found",
        "no_change": "the model fitted to the recordings of the known state: nothing changed",
        "parameters_only": f"{refit}: other parameters explain the gap, and no effect is needed",
        "none_of_these": f"{refit}: no effect of the library explains what is left of the gap",
    }.get(diagnosis.verdict, f"{refit}; undecided, so no effect was added")


def model_origin(composition: Composition, request: DiagnosisRequest) -> ModelOrigin:
    """What the models' files say besides values; what they have no place for, as a plugin."""
    try:
        return origin_of(composition) or ModelOrigin(option="")
    except ConfigurationError:
        effects = composition.config.get("effect") or {}
        node = dict(composition.config["model"])
        node.pop("parameters", None)  # they stand in the file
        return ModelOrigin(
            option=node, effects={name: effect_arguments(name, n) for name, n in effects.items()}
        )


def _write(
    request: DiagnosisRequest,
    origin: ModelOrigin,
    cause: Cause | None,
    values: Mapping[str, float],
    deviations: Mapping[str, float | None],
    path: Path,
    words: str,
    residual: Mapping[str, Mapping[str, Any]] | None = None,
) -> None:
    model, effects = request.problem.model, dict(origin.effects)
    for name in dict.fromkeys(size.split(".")[0] for size in values):
        if name in MODEL_FORM and name not in effect_names(model):
            model = extend_model(model, {name: MODEL_FORM[name]})
            effects[name] = {}  # of the library, with the values that were fitted
    parameter_names = [name for name in values if name in model.parameters]
    free = free_parameters(model.parameters, parameter_names) if parameter_names else ()
    if cause is not None:
        candidates = request.candidates
        model = extend_model(model, {name: candidates.effects[name] for name in cause.effects})
        for name in cause.effects:
            effects[name] = effect_arguments(name, candidates.nodes[name])
        values = dict(values) | {name: size.value for name, size in cause.parameters.items()}
    for name, node in (residual or {}).items():
        effect = build(node, f"{_GROUP}.{name}")
        assert isinstance(effect, Effect)
        model = extend_model(model, {name: effect})
        effects[name] = effect_arguments(name, node)
    document = model_document(
        request.problem.datasets[0].name,
        model,
        ModelOrigin(option=origin.option, limits=origin.limits, effects=effects),
        values=values,
        deviations=deviations,
        free=free,
        source=f"diagnosed on {names_of_files(request.problem.datasets)}",
    )
    write_model(document, path, f"{command_line()}\n{words}")


#: Files of a diagnosis in its folder.
DOCUMENT_NAME, PAGE_NAME = "diagnosis.json", "report.html"


def perform(composition: Composition, listener: Listener, folder: Path | None = None) -> Done:
    """Diagnose what a configuration asks for; in the folder of an earlier one, go on with that.

    Raises Interrupted if it was stopped.
    """
    begin = perf_counter()
    from trms_cli.gap.diagnose import diagnose
    from trms_cli.reporting.progress import LOG_NAME, STAGES_NAME, DiagnoseProgress

    request = request_of(composition)
    model_origin(composition, request)  # refused before anything is computed
    again = folder is not None
    folder = folder or composition.folder("diagnose")
    write_config(composition, folder)
    words, facts = _words(composition, request), dict(_facts(request))
    listener.begin(words, facts)
    progress = DiagnoseProgress(
        folder / STAGES_NAME,
        folder / LOG_NAME,
        request.fingerprint,
        resume=again,
        quiet=listener.quiet,
    )
    for line in (command_line(), words, *facts.values(), *request.problem.warnings):
        progress.note(line)
    try:
        with progress:
            diagnosis = diagnose(request.problem, progress)
    except KeyboardInterrupt:
        how = f"{program()} diagnose resume={shlex.quote(str(folder))}"
        if progress.exit_code == EXIT_TERMINATED:
            raise Interrupted(folder, how, EXIT_TERMINATED) from None
        raise Interrupted(folder, how) from None
    result = conclude(composition, request, diagnosis, folder)
    progress.finish(f"verdict {diagnosis.verdict}: {diagnosis.sentence}")
    spent = {"time": wording.seconds(perf_counter() - begin)}
    return Done(folder, replace(result, measures=(), facts=spent))


def conclude(
    composition: Composition, request: DiagnosisRequest, diagnosis: DiagnosisResult, folder: Path
) -> Findings:
    """Write models, figures and report of a diagnosis into its folder; what there is to tell."""
    from trms_cli.gap.diagnosis import document_of
    from trms_cli.gap.findings import findings
    from trms_cli.runs.run_folder import write_document

    origin = model_origin(composition, request)
    warnings = dict.fromkeys((*request.problem.warnings, *diagnosis.warnings))
    diagnosis = replace(diagnosis, versions=versions(), warnings=tuple(warnings))
    files = {"figures": folder / DOCUMENT_NAME}
    files["model"] = write_models(request, origin, diagnosis, folder)
    if request.options.advises:
        worth = _worth(composition, request, diagnosis, files["model"])
        diagnosis = replace(diagnosis, worth=worth)
    control = _control(composition, request, diagnosis, files["model"])
    diagnosis = replace(
        diagnosis,
        control=tuple(control),
        next_experiment=_on_the_rig(composition, request, diagnosis.next_experiment),
    )
    write_document(document_of(diagnosis), files["figures"])
    result = findings(diagnosis, request.remarks, folder)
    if request.options.page:
        from trms_cli.reporting.page import write_page

        facts = {**result.facts, "command": f"`{command_line()}`"}
        page_findings = replace(result, facts=facts)
        if request.options.effort == "quick":
            page_findings = _without_drawings(page_findings)
        page = write_page(page_findings, folder / PAGE_NAME, pictures=False, interactive=False)
        files |= {"report": page} if page else {}
    return replace(result, files=files)


def _without_drawings(result: Findings) -> Findings:
    """What a quick diagnosis has to tell: drawing takes a quarter of its time."""
    sections = []
    for section in result.sections:
        remaining_blocks = [
            block for block in section.blocks if not isinstance(block, Chart | RigDiagram)
        ]
        if remaining_blocks or not section.blocks:
            sections.append(replace(section, blocks=remaining_blocks))
    return replace(result, sections=sections)


def _worth(
    composition: Composition, request: DiagnosisRequest, diagnosis: DiagnosisResult, file: Path
) -> Worth | None:
    """What the corrected model gains in the loop; None where none is corrected, or it cannot be."""
    from trms_cli.composition.composer import compose
    from trms_cli.gap.worth import (
        DURATION,
        JUDGED_CONTROLLERS,
        judged_references,
        sine_within,
        worth_of,
    )
    from trms_cli.library.tasks.experiment import experiment_of

    if applied_cause(diagnosis) is None and diagnosis.verdict != "parameters_only":
        return None
    reference = _reference(request)
    if not reference:
        return None
    words = [f"controller={CONTROLLER}", *reference, f"sim.duration={DURATION:g}"]
    overrides = [f"model={file}", *words]
    command = shlex.join([*program().split(), "run", *overrides, *own_options(composition)])

    def loop(words: Sequence[str]) -> Experiment:
        return experiment_of(
            compose([f"model={file}", *words], config_dirs=composition.config_dirs).config
        )

    try:
        model, duration = request.problem.model, f"sim.duration={DURATION:g}"
        sines = sine_within(request.problem.datasets, model.controlled)
        loops = {
            (controller, name): loop([f"controller={controller}", *its_words, duration])
            for controller in JUDGED_CONTROLLERS
            for name, its_words in judged_references(sines, controller).items()
        }
        return worth_of(loop(words), model, controller=CONTROLLER, command=command, loops=loops)
    except TrmsError:
        return None  # a rig that the loop does not suit is diagnosed all the same


def _reference(request: DiagnosisRequest) -> list[str]:
    """Overrides of a sine within the recorded range; none where an angle was not recorded."""
    from trms_cli.gap.worth import FREQUENCY, reference_words, sine_within

    model = request.problem.model
    sines = sine_within(request.problem.datasets, model.controlled)
    if set(sines) != set(model.controlled):
        return []
    return reference_words("sine", sines, FREQUENCY)


def _control(
    composition: Composition, request: DiagnosisRequest, diagnosis: DiagnosisResult, file: Path
) -> Iterator[ControlCommand]:
    """What controls with the corrected model; nothing where none is corrected.

    Where its worth was simulated, the same reference; on a rig that is known by its log alone.
    """
    if diagnosis.verdict in ("no_gap", "no_change"):
        return
    sources = [dataset.source for dataset in request.problem.datasets]
    words = _reference(request) if diagnosis.worth is not None else []
    for line in control_commands(
        request.problem.model, file, sources, composition, kind="corrected", words=words
    ):
        yield ControlCommand(command=line.text, why=line.why)


def _on_the_rig(
    composition: Composition, request: DiagnosisRequest, experiment: NextExperiment | None
) -> NextExperiment | None:
    """An experiment, on the rig that was recorded where its log knows it."""
    if experiment is None:
        return None
    problem = request.problem
    sources = [dataset.source for dataset in problem.datasets]
    command = on_recorded_rig(experiment.command, problem.model, sources, composition)
    return replace(experiment, command=command)


def _words(composition: Composition, request: DiagnosisRequest) -> str:
    problem = request.problem
    words = [problem.model_name]
    if composition.config.get("effect"):
        words.append(f"with {', '.join(composition.config['effect'])}")
    words.append(wording.count(len(request.candidates.effects), "candidate"))
    return " · ".join([*words, f"effort {problem.effort}"])


def _facts(request: DiagnosisRequest) -> Iterator[tuple[str, str]]:
    lines = [
        f"{dataset.source}  {dataset.duration:g} s at {1 / dataset.sample_time:g} Hz  "
        + ", ".join(signal.name for signal in dataset.outputs)
        for dataset in request.problem.datasets
    ]
    yield "on", "\n".join(lines)
    if request.problem.against:
        yield "against", ", ".join(d.source for d in request.problem.against)
    if request.remarks:
        yield "note", "\n".join(request.remarks)
