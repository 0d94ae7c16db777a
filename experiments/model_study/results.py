"""All results of the study, as figures with a name that can be held against recorded ones."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from experiments.command_line import side_by_side
from experiments.expected_figures import json_text, rounded
from experiments.model_study.fits import Fitted, fit_all
from experiments.model_study.judgement import ANGLES, Judgement, judge
from experiments.model_study.loops import LoopRun, acceptance, close_loops
from experiments.model_study.ranking import Standing, rank
from experiments.model_study.record import FILE, RecordResult, judge_record
from experiments.model_study.rigs import Recordings, draw_rig, record
from experiments.model_study.study import Study

SCHEMA = "trms.model_study/1"
_RECORD = "record"


@dataclass(frozen=True)
class RigResult:
    """What came out on a rig."""

    seed: int
    largest: float  #: Angle over its stop, in the recordings
    fits: Mapping[str, Fitted]
    judgements: Mapping[str, Judgement]
    loops: Mapping[str, Mapping[str, LoopRun]]  #: By task and model


@dataclass(frozen=True)
class Results:
    """What came out on all rigs."""

    study: Study
    rigs: tuple[RigResult, ...]
    #: Of the first rig: which law takes which model, by law and model; empty, or why not
    acceptance: Mapping[str, Mapping[str, str]]
    record: RecordResult | None

    @cached_property
    def names(self) -> list[str]:
        """Models that could be fitted to every rig on which they are tried."""
        return [n for n in self.study.entrants() if all(r.fits[n].model for r in self.rigs_of(n))]

    def rigs_of(self, name: str) -> list[RigResult]:
        """Those on which a model is tried."""
        return [rig for rig in self.rigs if name in rig.fits]

    @cached_property
    def common(self) -> list[RigResult]:
        """Rigs on which all models are tried: levels of different models are told of these."""
        return [rig for rig in self.rigs if all(name in rig.fits for name in self.names)]

    def over_no_change(self, name: str, channels: Iterable[str] = (), horizon: str = "") -> float:
        """Error of free runs over that of no change, geometric mean over :attr:`common`."""
        worst, chosen = self.study.worst, tuple(channels)
        return geometric(r.judgements[name].relative(worst, chosen, horizon) for r in self.common)

    def free_run_errors(
        self, name: str, channels: Iterable[str] = (), horizon: str = ""
    ) -> list[float]:
        """Over those of no change, rig by rig; NaN where it is not tried."""
        worst, chosen = self.study.worst, tuple(channels)
        return [
            r.judgements[name].relative(worst, chosen, horizon)
            if name in r.judgements
            else float("nan")
            for r in self.rigs
        ]

    def loop_errors(self, name: str, tasks: Iterable[str]) -> list[float]:
        """Geometric mean over tasks, rig by rig, rad; NaN where it is not tried."""
        chosen = list(tasks)
        return [
            geometric([r.loops[task][name].error for task in chosen])
            if name in r.fits
            else float("nan")
            for r in self.rigs
        ]

    @cached_property
    def ranked_tasks(self) -> list[str]:
        """Tasks that were done, of those that are ranked."""
        return [task for task in self.study.loops.ranked if task in self.study.loops.chosen()]

    @cached_property
    def by_loop(self) -> list[Standing]:
        """The ranking: errors in the loop under the same MPC."""
        return rank({n: self.loop_errors(n, self.ranked_tasks) for n in self.names})

    @cached_property
    def by_free_runs(self) -> list[Standing]:
        """The ranking by errors of free runs over those of no change."""
        return rank({n: self.free_run_errors(n) for n in self.names})

    def seconds(self, name: str) -> float:
        """Of a fit, median over the rigs."""
        return float(np.median([r.fits[name].seconds for r in self.rigs_of(name)]))

    def step_ms(self, name: str, task: str) -> float:
        """Controller and observer in a control sample, median over the rigs."""
        return float(np.nanmedian([r.loops[task][name].step_ms for r in self.rigs_of(name)]))


def compute(
    study: Study, jobs: int, record_folder: Path | None, report: Callable[[str], None]
) -> Results:
    """Everything: recordings of all rigs at once, then rig by rig.

    ``record_folder``: with the record of the real rig; None: without.
    """
    rigs = [draw_rig(study, seed) for seed in study.rigs.seeds]
    with tempfile.TemporaryDirectory(prefix="trms-models-") as scratch:
        report(f"recording {len(rigs)} rigs")
        recordings = record(rigs, study, Path(scratch))
        tasks: dict[str, tuple[Any, ...]] = {
            str(seed): (study, seed, own, Path(scratch, str(seed)))
            for seed, own in recordings.items()
        }
        if study.record is not None and record_folder is not None:
            tasks[_RECORD] = (study, 0, record_folder, Path(scratch, _RECORD))
        done: dict[str, Any] = {}
        for name, future in side_by_side(_work, tasks, jobs, 1):
            done[name] = future.result()
            report(f"fitted, judged and controlled: {len(done)} of {len(tasks)}")
    rig_results: list[RigResult] = []
    accepted: dict[str, dict[str, str]] = {}
    for seed in study.rigs.seeds:
        result, answers = done[str(seed)]
        rig_results.append(result)
        accepted = accepted or answers
    return Results(study, tuple(rig_results), accepted, done.get(_RECORD))


def _work(study: Study, seed: int, what: Recordings | Path, folder: Path) -> Any:
    """A rig, or the record."""
    if isinstance(what, Path):
        assert study.record is not None
        return judge_record(what, study.record, study.horizons, folder)
    return study_rig(study, seed, what, folder)


def study_rig(
    study: Study, seed: int, recordings: Recordings, folder: Path
) -> tuple[RigResult, dict[str, dict[str, str]]]:
    """Fit all models to a rig, judge them, close their loops.

    Of the first rig also which law takes which model.
    """
    rig = draw_rig(study, seed)
    fits = fit_all(study.entrants_of(seed), [f"real='{recordings.fitted}'"], folder)
    models = {name: fitted.model for name, fitted in fits.items() if fitted.model}
    judged = ",".join(f"'{path}'" for path in recordings.judged)
    judgements = judge(models, [f"real=[{judged}]"], study.horizons)
    loops = close_loops(rig, models, study)
    accepted = acceptance(rig, models, study) if seed == study.rigs.seeds[0] else {}
    return RigResult(seed, recordings.largest, fits, judgements, loops), accepted


def record_of(folder: Path | None) -> Path | None:
    """The folder if it holds the record."""
    return folder if folder is not None and (folder / FILE).is_file() else None


def figures_of(results: Results) -> dict[str, dict[str, Any]]:
    """All figures that are recorded; none of the machine."""
    study = results.study
    free: dict[str, Any] = {}
    loops: dict[str, Any] = {}
    ranking: dict[str, Any] = {}
    for name in results.names:
        free[name] = results.over_no_change(name)
        for horizon in map(str, study.horizons):
            for angle in ANGLES:
                free[f"{name}/{angle}/{horizon}"] = results.over_no_change(name, [angle], horizon)
        free[f"{name}/failed_tests"] = float(
            np.median([r.judgements[name].failed_tests for r in results.common])
        )
        for task in study.loops.chosen():
            for axis in ("pitch", "yaw"):
                loops[f"{task}/{name}/{axis}"] = float(
                    np.mean([r.loops[task][name].rmse[axis] for r in results.common])
                )
    for part, standings in (("loop", results.by_loop), ("free_runs", results.by_free_runs)):
        for s in standings:
            ranking[f"{part}/{s.name}"] = s.against_first.value
            ranking[f"{part}/{s.name}/low"] = s.against_first.low
            ranking[f"{part}/{s.name}/failures"] = s.failures
    accepted = {
        f"{law}/{model}": problem or "yes"
        for law, answers in results.acceptance.items()
        for model, problem in answers.items()
    }
    figures = {"free_runs": free, "loops": loops, "ranking": ranking, "acceptance": accepted}
    if results.record is not None:
        figures["record"] = _record_figures(results.record, study.worst)
    return {part: rounded(values) for part, values in figures.items()}


def _record_figures(record: RecordResult, worst: float) -> dict[str, Any]:
    figures: dict[str, Any] = {}
    for prefix, judgements in (("", record.judgements), ("form/", record.forms)):
        for name, judgement in judgements.items():
            figures[f"{prefix}{name}"] = judgement.relative(worst)
            for channel in ANGLES:
                for horizon, error in judgement.errors[channel].items():
                    figures[f"{prefix}{name}/{channel}/{horizon}"] = error
    return figures


def document_of(full: Mapping[str, Any], quick: Mapping[str, Any]) -> str:
    """The recorded figures as JSON."""
    return json_text({"schema": SCHEMA, "full": full, "quick": quick})


def details_of(results: Results) -> dict[str, Any]:
    """Everything but traces, for whoever wants to draw on."""
    content: dict[str, Any] = {"schema": SCHEMA, "figures": figures_of(results), "rigs": []}
    for rig in results.rigs:
        models = {
            name: {
                "fit_seconds": rig.fits[name].seconds,
                "coefficients": rig.fits[name].coefficients,
                "problem": rig.fits[name].problem,
                "errors": rig.judgements[name].errors if name in rig.judgements else None,
                "unchanged": rig.judgements[name].unchanged if name in rig.judgements else None,
                "loops": {
                    task: {
                        "rmse": runs[name].rmse,
                        "movement": runs[name].movement,
                        "step_ms": runs[name].step_ms,
                        "problem": runs[name].problem,
                    }
                    for task, runs in rig.loops.items()
                    if name in runs
                },
            }
            for name in rig.fits
        }
        content["rigs"].append({"seed": rig.seed, "largest_angle": rig.largest, "models": models})
    plain: dict[str, Any] = rounded(content)
    return plain


def geometric(values: Iterable[float]) -> float:
    """Geometric mean of what is not NaN."""
    present = np.array([value for value in values if not np.isnan(value)])
    with np.errstate(divide="ignore"):
        return float(np.exp(np.mean(np.log(present))))
