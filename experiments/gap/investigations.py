"""``python -m experiments.gap.investigations``: are alike causes told apart within the budget?

Rigs of the blind benchmark, whose code shares nothing with the models: pairs of one rig with the
one and the other of two effects that are hard to tell apart (``matched``). Each is investigated as
``trms investigate`` does: a first excitation, then what each diagnosis advises, as large as all
rigs that are still possible stand, until one answer is sure or the budget is spent. The rigs of a
round are simulated side by side. What is in the folder is not made again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from time import process_time

import numpy as np
import numpy.typing as npt

from experiments.command_line import exit_code_of
from experiments.gap.blind.cases import Case, plan
from experiments.gap.blind.drivers import OpenLoop
from experiments.gap.blind.recording import (
    Recording,
    at_stops,
    csv_of,
    rigs_of,
)
from experiments.gap.blind.rig import COMMAND_LIMIT
from trms_cli.core.data_file import read_json
from trms_cli.core.errors import EXIT_OK, ConfigurationError
from trms_cli.core.threads import take_one_thread
from trms_cli.gap.diagnosis import DiagnosisResult
from trms_cli.gap.investigation import (
    Ensemble,
    ExperimentPlan,
    ExperimentRecord,
    Investigation,
    RigLimits,
    advised_plan,
    document_of,
    ending_of,
    excitation_plan,
    posterior_ensemble,
    prior_ensemble,
    read_document,
    wants_excitation,
)
from trms_cli.identification.excitation.design import ExcitationRequest
from trms_cli.identification.excitation.multilevel import MultilevelExcitation
from trms_cli.library.tasks.investigate import diagnose_together, diagnosis_composition
from trms_cli.models.model import Model
from trms_cli.runs.run_folder import write_document

FloatArray = npt.NDArray[np.float64]

#: s, of all recordings; of the first experiment, and of the way to its operating point.
SAMPLE_TIME, FIRST, LEAD_IN = 0.02, 70.0, 10.0
#: Cases of the set among which matched ones are looked for.
_PLANNED = 300
_DOCUMENT = "investigation.json"
_LIMITS = RigLimits(np.full(2, -COMMAND_LIMIT), np.full(2, COMMAND_LIMIT))


@dataclass(frozen=True)
class Subject:
    """A rig under investigation."""

    case: Case
    folder: Path

    @property
    def truth(self) -> str:
        """Its effect."""
        return next(iter(self.case.effects))

    def investigation(self, budget: float, sure: float) -> Investigation:
        """As it stands; with a larger budget what had spent its own goes on."""
        file = self.folder / _DOCUMENT
        if not file.is_file():
            return Investigation(budget=budget, sure=sure)
        kept = read_document(read_json(file))
        kept.budget, kept.sure = budget, sure
        if kept.ending == "budget" and kept.allows(40.0):
            kept.ending = None
        return kept

    def plan_file(self, number: int) -> Path:
        """Commands of an experiment that is planned or made."""
        return self.folder / f"plan-{number}.npz"


def main(argv: Sequence[str] | None = None) -> int:
    """Investigate, and print how many were told apart."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.gap.investigations",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--rigs", type=int, default=20, help="how many, two of each pair")
    parser.add_argument("--effect", default="", help="only the pairs with it")
    parser.add_argument("--seed", type=int, default=7, help="of the set")
    parser.add_argument("--budget", type=float, default=300.0, help="s of rig time")
    parser.add_argument("--sure", type=float, default=0.95)
    parser.add_argument("--effort", default="quick")
    parser.add_argument("--jobs", type=int, default=1, help="threads of a diagnosis")
    parser.add_argument("--table", action="store_true", help="print what there is, make nothing")
    parser.add_argument("--out", type=Path, default=Path("outputs/investigations"))
    arguments = parser.parse_args(argv)
    take_one_thread()
    return exit_code_of(lambda: _study(arguments))


def _study(arguments: argparse.Namespace) -> int:
    begin = process_time()
    subjects = subjects_of(arguments.seed, arguments.rigs, arguments.out, arguments.effect)
    words = [f"effort={arguments.effort}", f"jobs={arguments.jobs}"]
    while not arguments.table:
        waiting = []
        for subject in subjects:
            investigation = subject.investigation(arguments.budget, arguments.sure)
            if _next_plan(subject, investigation, words) is not None:
                waiting.append(subject)
            subject.folder.mkdir(parents=True, exist_ok=True)
            write_document(document_of(investigation), subject.folder / _DOCUMENT)
        if not waiting:
            break
        _record(waiting, arguments.budget, arguments.sure, arguments.seed)
    states = [(s, s.investigation(arguments.budget, arguments.sure)) for s in subjects]
    print("\n".join(table(states)))
    print(f"{process_time() - begin:.0f} s of processor time; all in {arguments.out}")
    return EXIT_OK


def subjects_of(seed: int, count: int, out: Path, effect: str = "") -> list[Subject]:
    """Matched rigs of the development set, twins next to each other.

    ``effect``: of the rigs counted only the pairs that have it; empty: all of them.
    """
    matched = [c for c in plan("development", seed, cases=_PLANNED) if c.kind == "matched"]
    matched.sort(key=lambda case: (case.twin, next(iter(case.effects))))
    if not 0 < count <= len(matched):
        raise ConfigurationError(
            f"{count} given", where="--rigs", remedy=f"from 1 to {len(matched)}"
        )
    return [
        Subject(case, out / f"{case.twin:02}-{next(iter(case.effects))}")
        for case in matched[:count]
        if not effect or effect in case.group
    ]


@cache
def _model() -> Model:
    from trms_cli.composition.composer import compose
    from trms_cli.library.tasks.subject import model_of

    return model_of(compose([], "excite").config)


def _next_plan(subject: Subject, investigation: Investigation, words: Sequence[str]) -> Path | None:
    """The commands that are recorded next, (n, 2) V in a file; None where there are none."""
    number = len(investigation.experiments) + 1
    file = subject.plan_file(number)
    if investigation.ending is not None:
        return None
    if file.is_file():
        return file
    diagnosis: DiagnosisResult | None = None
    ensemble = prior_ensemble(_model(), _LIMITS, SAMPLE_TIME, subject.case.twin)
    if investigation.recordings:
        composition = diagnosis_composition(words, investigation.recordings)
        problem, diagnosis = diagnose_together(composition, subject.folder)
        investigation.experiments[-1].diagnosed(diagnosis)
        top = max(diagnosis.causes, key=lambda cause: cause.probability)
        _tell(
            f"{subject.folder.name}: {investigation.spent:.0f} s, {'+'.join(top.effects)} "
            f"{top.probability:.3f}"
        )
        if ending := ending_of(investigation, diagnosis):
            investigation.end(*ending)
            return None
        ensemble = posterior_ensemble(
            diagnosis, _model(), problem.candidates.effects, _LIMITS, SAMPLE_TIME, number
        )
    plan_ = _plan(subject, diagnosis, ensemble, number)
    if plan_ is None:
        investigation.end("too_large", "no amplitude keeps all rigs that are possible in bounds")
        return None
    if not investigation.allows(len(plan_.commands) * SAMPLE_TIME):
        investigation.end("budget", "the budget is spent")
        return None
    subject.folder.mkdir(parents=True, exist_ok=True)
    np.savez(file, commands=plan_.commands, words=plan_.words, why=plan_.why, share=plan_.share)
    return file


def _plan(
    subject: Subject, diagnosis: DiagnosisResult | None, ensemble: Ensemble, number: int
) -> ExperimentPlan | None:
    if diagnosis is not None and not wants_excitation(diagnosis):
        return advised_plan(diagnosis, ensemble)
    seed = 100 * subject.case.twin + number
    request = ExcitationRequest(
        duration=FIRST - LEAD_IN, sample_time=SAMPLE_TIME, lead_in=LEAD_IN, seed=seed
    )
    why = "a first look" if diagnosis is None else "longer"
    return excitation_plan(_model(), MultilevelExcitation(), request, ensemble, _LIMITS, why)


def _record(subjects: Sequence[Subject], budget: float, sure: float, seed: int) -> None:
    """Drive the rigs side by side, each by its own commands, from rest."""
    states = [subject.investigation(budget, sure) for subject in subjects]
    plans = [
        np.load(subject.plan_file(len(state.experiments) + 1))
        for subject, state in zip(subjects, states, strict=True)
    ]
    tables = [plan_["commands"] for plan_ in plans]
    longest = max(map(len, tables))
    _tell(f"recording {len(subjects)} rigs for {longest * SAMPLE_TIME:.0f} s")
    padded = [np.pad(t, ((0, longest - len(t)), (0, 0)), mode="edge") for t in tables]
    cases = [replace(subject.case, drive="rich", channels="four") for subject in subjects]
    number = 1 + sum(len(state.experiments) for state in states)
    own = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
    run = rigs_of(cases, own).run(
        OpenLoop(np.array(padded)), longest * SAMPLE_TIME, SAMPLE_TIME, 0.0
    )
    for i, (subject, state, plan_) in enumerate(zip(subjects, states, plans, strict=True)):
        k = len(tables[i])
        recording = Recording(run.time[:k], run.commands[i, :k], run.measured[i, :k])
        experiment = len(state.experiments) + 1
        file = subject.folder / f"experiment-{experiment}.csv"
        file.write_text(csv_of(cases[i], recording))
        if at_stops(recording):
            _tell(f"{subject.folder.name}: experiment {experiment} came to a stop")
        state.experiments.append(
            ExperimentRecord(
                number=experiment,
                words=str(plan_["words"]),
                why=str(plan_["why"]),
                log=str(file),
                seconds=k * SAMPLE_TIME,
                recorded=k * SAMPLE_TIME,
                share=float(plan_["share"]),
            )
        )
        write_document(document_of(state), subject.folder / _DOCUMENT)


def table(states: Iterable[tuple[Subject, Investigation]]) -> list[str]:
    """A line a rig, then the share told apart by pair and of all."""
    lines: list[str] = []
    told_by_pair: dict[str, list[tuple[bool, bool, Investigation]]] = {}
    for subject, state in states:
        last = next((e for e in reversed(state.experiments) if e.probabilities), None)
        probabilities = last.probabilities if last else {}
        top = max(probabilities, key=lambda name: probabilities[name], default="")
        sure = probabilities.get(top, 0.0) >= state.sure
        first = next((e for e in state.experiments if e.probabilities), None)
        before = first.probabilities.get(subject.truth, 0.0) if first else 0.0
        lines.append(
            f"{subject.folder.name:32} {len(state.experiments)} experiments {state.spent:4.0f} s  "
            f"p(truth) {before:.3f} → {probabilities.get(subject.truth, 0.0):.3f}  "
            f"{'right' if sure and top == subject.truth else 'WRONG' if sure else 'open':5}  "
            f"{state.ending or 'goes on'}  {top}"
        )
        pair = " / ".join(subject.case.group)
        told_by_pair.setdefault(pair, []).append((sure and top == subject.truth, sure, state))
    lines.append("")
    every = [entry for entries in told_by_pair.values() for entry in entries]
    for pair, entries in [*sorted(told_by_pair.items()), ("all", every)]:
        ended = [entry for entry in entries if entry[2].ending is not None]
        right, wrong = sum(e[0] for e in ended), sum(e[1] and not e[0] for e in ended)
        lines.append(f"{pair:52} told apart {right} of {len(ended)}, wrong and sure {wrong}")
    return lines


def _tell(words: str) -> None:
    sys.stderr.write(f"{words}\n")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
