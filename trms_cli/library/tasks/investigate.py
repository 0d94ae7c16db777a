"""An investigation: experiments and diagnoses in turn, each experiment a run with its own log."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from trms_cli.composition.arguments import text_of
from trms_cli.composition.composer import Composition, compose
from trms_cli.core import wording
from trms_cli.core.data_file import read_json
from trms_cli.core.errors import ConfigurationError, RecordingError, SimulationError, TrmsError
from trms_cli.core.findings import Findings, NextCommand, Section, Table
from trms_cli.core.invocation import note, program
from trms_cli.core.plugins import build, check_contract, construct
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.gap.diagnosis import DiagnosisResult
from trms_cli.gap.investigation import (
    Ensemble,
    ExperimentPlan,
    ExperimentRecord,
    Investigation,
    RigLimits,
    advised_plan,
    columns_of,
    document_of,
    ending_of,
    excitation_plan,
    posterior_ensemble,
    prior_ensemble,
    read_document,
    wants_excitation,
)
from trms_cli.gap.wording import cause_name
from trms_cli.library.tasks import diagnose, run
from trms_cli.library.tasks.excite import playing
from trms_cli.library.tasks.files import write_config
from trms_cli.library.tasks.subject import several
from trms_cli.library.tasks.task import Done, Interrupted, Listener
from trms_cli.models.model import Model, names
from trms_cli.plants.envelope import envelope_of
from trms_cli.plants.landing import landing_of
from trms_cli.plants.plant import PlantSetup

#: Files of an investigation in its folder.
DOCUMENT_NAME, DIAGNOSIS_NAME = "investigation.json", "diagnosis"
#: Keys of the configuration that are plugins of their own.
_GROUPS = ("model", "plant", "effect", "excitation", "data")
#: Which of what was typed is for the runs, and which for the diagnoses.
_OF_RUNS, _OF_DIAGNOSES = ("model", "plant", "effect"), ("model", "data", "candidates")
#: Keys with one value for both.
_SHARED = ("effort", "jobs", "page")


@dataclass(frozen=True, kw_only=True)
class InvestigateOptions:
    """The keys of ``configs/investigate.yaml`` that are no group."""

    candidates: str | tuple[str, ...] = ("all",)
    budget: Positive = 300.0  #: s of rig time
    sure: Annotated[float, Meta(gt=0.5, lt=1)] = 0.95  #: Probability at which a cause is told
    first: Positive = 70.0  #: s of the first experiment, lead-in included
    lead_in: NotNegative = 10.0  #: s
    sample_time: Positive = 0.02  #: s
    arm: bool = False  #: Whether no person is asked
    effort: Literal["quick", "normal", "thorough"] = "normal"
    seed: Annotated[int, Meta(ge=0)] = 0
    jobs: Annotated[int, Meta(ge=1)] = 2
    out: str | None = None
    page: bool = True


@dataclass(frozen=True)
class _Request:
    """What was asked for, built."""

    composition: Composition
    options: InvestigateOptions
    model: Model  #: Nominal
    plant: Any
    limits: RigLimits

    @property
    def is_real(self) -> bool:
        return bool(getattr(self.plant, "real_time", False))

    def landing_time(self, commands: np.ndarray) -> float:
        """How long the landing after commands (n, n_u) V lasts, s; 0 where there is none."""
        landing, step = landing_of(self.plant), self.options.sample_time
        if not landing.after_run:
            return 0.0
        return landing.samples(float(np.abs(commands[-1]).max()), step) * step


def perform(composition: Composition, listener: Listener, folder: Path | None = None) -> Done:
    """Investigate the rig that a configuration names; in the folder of an earlier one, go on.

    Raises Interrupted if it was stopped: what was recorded is kept.
    """
    begin = perf_counter()
    request = _request(composition)
    if folder is None:
        investigation = Investigation(budget=request.options.budget, sure=request.options.sure)
        folder = composition.folder("investigate")
        write_config(composition, folder)
    else:
        investigation = read_document(read_json(folder / DOCUMENT_NAME))
        investigation.budget, investigation.sure = request.options.budget, request.options.sure
        investigation.ending, investigation.sentence = None, ""
    listener.begin(*_words(request))
    work = _Work(request, listener, folder, investigation)
    try:
        diagnosis = work.investigate()
        findings = work.conclude(diagnosis) if diagnosis is not None else Findings("", [])
    except KeyboardInterrupt as stopped:
        work.save()
        code = getattr(stopped, "exit_code", None)
        raise Interrupted(folder, work.how(), *(() if code is None else (code,))) from None
    facts = {"time": wording.seconds(perf_counter() - begin)}
    return Done(folder, replace(findings, measures=(), facts=facts))


def diagnosis_composition(
    words: Sequence[str], recordings: Sequence[str], config_dirs: Sequence[Path] = ()
) -> Composition:
    """That of ``trms diagnose`` over recordings; ``words``: other overrides."""
    real = f"real=[{','.join(text_of(recording) for recording in recordings)}]"
    return compose([*words, real], "diagnose", config_dirs=config_dirs)


def diagnose_together(
    composition: Composition, folder: Path, *, quiet: bool = True
) -> tuple[diagnose.DiagnosisRequest, DiagnosisResult]:
    """What all recordings of a composed diagnosis say together, with the next experiment.

    Also a quick diagnosis advises one here: without it there is nothing to go on with.
    """
    from trms_cli.core.versions import versions
    from trms_cli.gap.diagnose import diagnose as solve
    from trms_cli.reporting.progress import LOG_NAME, STAGES_NAME, DiagnoseProgress

    request = diagnose.request_of(composition)
    progress = DiagnoseProgress(
        folder / STAGES_NAME, folder / LOG_NAME, request.fingerprint, quiet=quiet
    )
    with progress:
        result = solve(replace(request.problem, advise=True, investigates=True), progress)
    progress.finish(f"verdict {result.verdict}: {result.sentence}")
    return request, replace(result, versions=versions())


def write_commands(plan: ExperimentPlan, model: Model, sample_time: float, path: Path) -> None:
    """The commands as ``trms excite`` writes them."""
    from trms_cli.runs.run_folder import write_whole

    heads = ["t[s]", *(f"{signal.name}[{signal.unit}]" for signal in model.inputs)]
    lines = ["# made by: trms investigate", f"# {plan.words}", ",".join(heads)]
    for k, row in enumerate(plan.commands):
        lines.append(",".join([f"{k * sample_time:.9g}", *(f"{value:.6g}" for value in row)]))
    write_whole("\n".join(lines) + "\n", path)


class _Work:
    """An investigation under way."""

    def __init__(
        self, request: _Request, listener: Listener, folder: Path, investigation: Investigation
    ) -> None:
        self._request, self._listener = request, listener
        self._folder, self.investigation = folder, investigation
        self._problem: diagnose.DiagnosisRequest | None = None
        self._diagnosed: Composition | None = None

    def investigate(self) -> DiagnosisResult | None:
        """Experiments and diagnoses in turn; the last diagnosis, None where there is none."""
        investigation = self.investigation
        diagnosis: DiagnosisResult | None = None
        while True:
            if investigation.recordings:
                try:
                    diagnosis = self._diagnose()
                except RecordingError as error:
                    if diagnosis is None:
                        raise
                    self._leave_out(error)
                    break
                if ending := ending_of(investigation, diagnosis):
                    investigation.end(*ending)
                    break
            plan = self._plan(diagnosis)
            if plan is None or not self._has_time_for(plan):
                break
            if not self._record(plan):
                break
        self.save()
        return diagnosis

    def _leave_out(self, error: RecordingError) -> None:
        """Go no further with a recording that a diagnosis refuses; the ones before stand."""
        last = self.investigation.experiments[-1]
        last.usable = False
        self.investigation.end(
            "unusable",
            f"the recording of experiment {last.number} is not one to diagnose: {error.problem}",
        )

    def _plan(self, diagnosis: DiagnosisResult | None) -> ExperimentPlan | None:
        """The next experiment; None where no amplitude keeps all possible rigs within bounds."""
        ensemble = self._ensemble(diagnosis)
        with self._listener.progress() as line:
            line.tell("simulating the rigs that are possible")
            if diagnosis is None or wants_excitation(diagnosis):
                plan = self._excitation(ensemble, diagnosis, line.tell)
            else:
                plan = advised_plan(diagnosis, ensemble)
        if plan is None:
            self.investigation.end(
                "too_large",
                f"at no amplitude do all {len(ensemble)} rigs that are possible stay off their "
                "stops and within the envelope",
            )
        return plan

    def _ensemble(self, diagnosis: DiagnosisResult | None) -> Ensemble:
        r = self._request
        if diagnosis is None or self._problem is None:
            return prior_ensemble(r.model, r.limits, r.options.sample_time, r.options.seed)
        return posterior_ensemble(
            diagnosis,
            r.model,
            self._problem.candidates.effects,
            r.limits,
            r.options.sample_time,
            r.options.seed,
        )

    def _excitation(
        self, ensemble: Ensemble, diagnosis: DiagnosisResult | None, tell: Any
    ) -> ExperimentPlan | None:
        """The first experiment, and others like it with other commands."""
        from trms_cli.identification.excitation.design import ExcitationRequest

        r, advice = self._request, diagnosis.next_experiment if diagnosis else None
        kind = build(r.composition.config["excitation"], "excitation")
        if advice is not None and advice.prediction is None:
            from trms_cli.identification.excitation.multisine import MultisineExcitation

            kind = MultisineExcitation(periods=4, iterations=0)
        request = ExcitationRequest(
            duration=r.options.first - r.options.lead_in,
            sample_time=r.options.sample_time,
            lead_in=r.options.lead_in,
            seed=r.options.seed + len(self.investigation.experiments),
        )
        why = advice.why if advice is not None else "a first look at the rig"
        return excitation_plan(r.model, kind, request, ensemble, r.limits, why, tell)

    def _has_time_for(self, plan: ExperimentPlan) -> bool:
        duration = self._duration(plan)
        if self.investigation.allows(duration):
            return True
        left = self.investigation.budget - self.investigation.spent
        self.investigation.end(
            "budget",
            f"the next experiment ({plan.words}, {duration:.0f} s) is longer than the {left:.0f} s "
            f"that are left of {self.investigation.budget:g} s",
        )
        return False

    def _duration(self, plan: ExperimentPlan) -> float:
        """Rig time of an experiment, s."""
        seconds = len(plan.commands) * self._request.options.sample_time
        return seconds + self._request.landing_time(plan.commands)

    def _record(self, plan: ExperimentPlan) -> bool:
        """Make an experiment; whether it came to its end."""
        r, number = self._request, len(self.investigation.experiments) + 1
        while (self._folder / f"experiment-{number}").exists():  # of one that was lost
            number += 1
        commands = self._folder / f"experiment-{number}.csv"
        write_commands(plan, r.model, r.options.sample_time, commands)
        question = _Question(self._listener, _announcement(number, plan, self._duration(plan)))
        if r.is_real and not r.options.arm:
            note(question.words)
        composition = self._run_composition(number, plan, commands)
        log = self._folder / f"experiment-{number}" / "run.mcap"
        try:
            run.perform(composition, question)
        except KeyboardInterrupt:
            self._keep(number, plan, log, complete=False)
            raise
        except SimulationError as error:
            if not self._keep(number, plan, log, complete=False):
                raise
            self.investigation.end(
                "landed",
                f"experiment {number} ended with a landing ({error.problem}); go on once the rig "
                "is in order",
            )
            return False
        except ConfigurationError as error:
            if question.refused:
                self.save()
                raise ConfigurationError(
                    f"experiment {number} was not made: nobody confirmed it",
                    where="arm",
                    remedy="answer y on the terminal, or where nobody is to be asked: "
                    + (f"{self.how()} arm=true" if self.investigation.experiments else "arm=true"),
                ) from error
            raise
        self._keep(number, plan, log, complete=True)
        return True

    def _run_composition(self, number: int, plan: ExperimentPlan, commands: Path) -> Composition:
        r = self._request
        inputs = names(r.model.inputs)
        has_angles = any(signal.unit == "rad" for signal in r.model.outputs)
        words = [
            *_typed(r.composition, _OF_RUNS),
            *playing(inputs, text_of(str(commands)), has_angles=has_angles),
            f"sim.duration={text_of(len(plan.commands) * r.options.sample_time)}",
            f"sim.sample_time={text_of(r.options.sample_time)}",
            f"seed={r.options.seed + number}",
            f"out={text_of(str(self._folder / f'experiment-{number}'))}",
            "picture=false",
        ]
        if r.is_real and r.options.arm:
            words.append("plant.arm=true")
        return compose(words, "run", config_dirs=r.composition.config_dirs)

    def _keep(self, number: int, plan: ExperimentPlan, log: Path, *, complete: bool) -> bool:
        """Note an experiment; False where nothing of it was recorded."""
        from trms_cli.runs.run_folder import SCORE_NAME

        try:
            recorded = float(read_json(log.with_name(SCORE_NAME))["duration_s"])
        except (OSError, TrmsError, KeyError, TypeError, ValueError):
            return False
        landing = self._request.landing_time(plan.commands)
        self.investigation.experiments.append(
            ExperimentRecord(
                number=number,
                words=plan.words,
                why=plan.why,
                log=str(log),
                seconds=recorded + landing,
                recorded=recorded,
                share=plan.share,
                complete=complete,
            )
        )
        self.save()
        note(f"experiment {number}  {plan.words}, {recorded:.0f} s  {log}")
        return True

    def _diagnose(self) -> DiagnosisResult:
        """All recordings together."""
        options = self._request.options
        words = [
            *_typed(self._request.composition, _OF_DIAGNOSES),
            *(f"{key}={text_of(getattr(options, key))}" for key in _SHARED),
            f"seed={options.seed}",
        ]
        composition = diagnosis_composition(
            words, self.investigation.recordings, self._request.composition.config_dirs
        )
        folder = self._folder / DIAGNOSIS_NAME
        folder.mkdir(exist_ok=True)
        write_config(composition, folder)
        self._problem, result = diagnose_together(composition, folder, quiet=self._listener.quiet)
        self._diagnosed = composition
        self.investigation.experiments[-1].diagnosed(result)
        self.save()
        top = max(result.causes, key=lambda cause: cause.probability)
        count = wording.count(len(self.investigation.recordings), "recording")
        note(f"diagnosis     {count}: {cause_name(top.effects)}, p = {top.probability:.2f}")
        return result

    def conclude(self, diagnosis: DiagnosisResult) -> Findings:
        """Write the last diagnosis as ``trms diagnose`` does; what there is to tell."""
        assert self._problem is not None and self._diagnosed is not None
        folder = self._folder / DIAGNOSIS_NAME
        result = diagnose.conclude(self._diagnosed, self._problem, diagnosis, folder)
        investigation = self.investigation
        lead = [f"{_ending(investigation)}.", *result.lead]
        more = []
        if investigation.ending in ("budget", "landed"):
            needed = f"budget={investigation.budget + 120:g}"
            words = f"{self.how()} {needed}" if investigation.ending == "budget" else self.how()
            more.append(NextCommand(words, "goes on with this rig"))
        return replace(
            result,
            lead=lead,
            sections=[experiments_section(investigation), *result.sections],
            files={"record": self._folder / DOCUMENT_NAME, **result.files},
            next=[*more, *result.next],
        )

    def save(self) -> None:
        """Write what has been done so far."""
        from trms_cli.runs.run_folder import write_document

        if self.investigation.experiments:
            write_document(document_of(self.investigation), self._folder / DOCUMENT_NAME)

    def how(self) -> str:
        """What to type to go on."""
        return f"{program()} investigate resume={shlex.quote(str(self._folder))}"


class _Question(Listener):
    """Asks a person for one experiment, and remembers a no."""

    def __init__(self, listener: Listener, words: str) -> None:
        super().__init__("")
        self._listener, self.words, self.refused = listener, words, False

    def confirm(self, question: str) -> bool:
        """Whether the person agrees with the experiment."""
        agreed = self._listener.confirm(question)
        self.refused = not agreed
        return agreed

    def simulation(self, duration: float) -> Any:
        """Gives what moves a bar, on a terminal."""
        return self._listener.simulation(duration)


def experiments_section(investigation: Investigation) -> Section:
    """A row an experiment, with the probabilities after it."""
    answers = list(columns_of(investigation))
    rows = []
    for experiment in investigation.experiments:
        after = [experiment.probabilities.get(name) for name in answers]
        rows.append(
            [
                str(experiment.number),
                experiment.words + ("" if experiment.complete else " (broken off)"),
                f"{experiment.recorded:.0f}",
                f"{experiment.share:.0%}",
                *(None if p is None else f"{p:.2f}" for p in after),
            ]
        )
    heads = ["", "experiment", "s", "amplitude", *(cause_name(n.split("+")) for n in answers)]
    caption = (
        "Amplitude: share of the advised one with which all rigs that were possible then stayed "
        "within bounds. Probabilities: of all recordings up to and with the experiment."
    )
    return Section("Experiments", blocks=[Table(heads, rows, caption)])


def _ending(investigation: Investigation) -> str:
    count = wording.count(len(investigation.experiments), "experiment")
    return f"After {count} and {investigation.spent:.0f} s of rig time {investigation.sentence}"


def _announcement(number: int, plan: ExperimentPlan, duration: float) -> str:
    angles = ", ".join(
        f"{name} {low:.2f} to {high:.2f} rad"
        for name, (low, high) in plan.ranges.items()
        if name.startswith("alpha")
    )
    return (
        f"experiment {number}: {plan.words}, {duration:.0f} s, {plan.share:.0%} of the advised "
        f"amplitude; {plan.rigs} simulated rigs stay within {angles}"
    )


def _request(composition: Composition) -> _Request:
    """Build what a configuration asks for.

    Raises ConfigurationError for the first key that is wrong.
    """
    config = composition.config
    options = construct(
        InvestigateOptions, {key: value for key, value in config.items() if key not in _GROUPS}
    )
    if options.first > options.budget:
        raise ConfigurationError(
            f"{options.budget:g} s given, and the first experiment takes {options.first:g} s",
            where="budget",
            remedy="a larger budget; 300 s allow five more experiments",
        )
    if options.first - options.lead_in < 20:
        raise ConfigurationError(
            f"{options.first:g} s given, of which {options.lead_in:g} s lead in",
            where="first",
            remedy="at least 20 s after the lead-in, better 60 s",
        )
    model, plant = build(config["model"], "model"), build(config["plant"], "plant")
    build(config["excitation"], "excitation")
    diagnose.candidates_of(
        several(options.candidates, "candidates"), model, composition.config_dirs
    )
    is_real = bool(getattr(plant, "real_time", False))
    if is_real and config.get("effect"):
        raise ConfigurationError(
            f"{', '.join(config['effect'])} given, and a real rig has the effects that it has",
            where="effect",
            remedy="effects that are known already belong to the model: model=FILE.yaml",
        )
    check_contract(plant, "plant")
    setup = PlantSetup(options.sample_time, round(options.first / options.sample_time), 0, model)
    lower, upper = plant.init(setup).input_limits
    own_lower, own_upper = model.input_bounds()
    limits = RigLimits(
        np.maximum(lower, own_lower), np.minimum(upper, own_upper), envelope_of(plant)
    )
    return _Request(composition, options, model, plant, limits)


def _typed(composition: Composition, roots: Sequence[str]) -> list[str]:
    """What was typed for some parts: ``plant=udp``, ``plant.host=…``, ``wiring@plant.wiring=…``."""

    def root(word: str) -> str:
        key = word.lstrip("+~").partition("=")[0]
        return key.partition("@")[2].split(".")[0] if "@" in key else key.split(".")[0]

    return [word for word in composition.overrides if root(word) in roots]


def _words(request: _Request) -> tuple[str, Mapping[str, str]]:
    composition, options = request.composition, request.options
    labels = composition.choice_labels
    words = f"{labels.get('plant', '')} rig · {labels.get('model', '')} · effort {options.effort}"
    return words, {"budget": f"{options.budget:g} s of rig time, sure at {options.sure:g}"}
