"""What a person sees of a fit: what is fitted to what, then parameters, errors and files."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from trms_cli.commands.identify_request import Identification
from trms_cli.composition.composer import Composition
from trms_cli.core.invocation import program
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.method import FitResult

#: Parts of the recordings in the document, as a person reads them.
_PARTS = {"fit": "on what was fitted", "held_out": "on what was held out"}
#: Sets of parameters that imitate each other that are printed.
_MOST_SETS = 4
#: Prior deviations from which a fitted value is worth a line.
_FAR = 4.0
#: Growth of a held-out error that is more than its scatter.
_WORSE = 1.1


class IdentifyScreen:
    """Words on standard output; in a sweep one line a job.

    Parameters
    ----------
    composition : Composition
    asked : Identification
    folder : Path
    """

    def __init__(self, composition: Composition, asked: Identification, folder: Path) -> None:
        self._composition, self._asked, self._folder = composition, asked, folder
        self._quiet = composition.job is not None

    def say_begin(self) -> None:
        """What is fitted to what, and what was found in the recordings."""
        if self._quiet:
            return
        problem = self._asked.problem
        choices = self._composition.choices
        words = [str(choices.get("method")), f"model {choices.get('model')}"]
        if choices.get("effect"):
            words.append(f"effect {', '.join(choices['effect'])}")
        if self._asked.driven:
            words.append(f"driven by {', '.join(self._asked.driven)}")
        if problem.free:
            number = len(problem.free)
            words.append(f"{number} parameter{'s' if number > 1 else ''} free")
        _print_headed(f"identify   {' · '.join(words)}")
        print(f"fitted     {'; '.join(map(_part, problem.datasets))}")
        if problem.validation:
            print(f"held out   {'; '.join(map(_part, problem.validation))}")
        else:
            print("held out   nothing: how good the model is on other data stays unknown")
        remarks: dict[str, None] = {}
        for dataset in (*problem.datasets, *problem.validation):
            remarks |= dict.fromkeys(dataset.remarks)
        for remark in remarks:
            print(f"note       {remark}")
        for issue in self._asked.admission.warnings:
            print(f"warning    {issue}")
        if self._asked.idle:
            print(
                f"note       no part in the equations, so not fitted: {', '.join(self._asked.idle)}"
            )
        sys.stdout.flush()

    def say_fitted(self, result: FitResult) -> None:
        """How the fit ended."""
        if not self._quiet:
            print(
                f"fit        {result.outcome.value}\n"
                f"           {result.evaluations} simulations in {result.seconds:.1f} s, "
                f"cost {result.cost:.6g}"
            )
            sys.stdout.flush()

    def say_finished(
        self, document: Mapping[str, Any], model: Path, page: Path | None, whole: float
    ) -> None:
        """Parameters, errors, files, and what to do next."""
        if self._quiet:
            print(self._job_line(document))
            return
        for lines in (
            _parameter_lines(document["parameters"]),
            _doubt_lines(document),
            _error_lines(document["errors"]),
        ):
            section = list(lines)
            if section:
                print()
            for line in section:
                _print_headed(line)
        print(f"\ntime       {whole:.1f} s in all")
        print(f"model      {model}")
        print(f"numbers    {model.with_name('identification.json')}")
        if page is not None:
            print(f"page       {page}")
        print()
        where, trms = shlex.quote(str(model)), program()
        print(f"next       {trms} validate model={where} {self._judging()}")
        print(f"           {trms} run model={where}")
        if document["outcome"] in ("interrupted", "budget_spent") and self._resumable:
            print(f"           {trms} identify resume={shlex.quote(str(self._folder))}", end="")
            longer = _more(self._composition.config["method"])
            print(f" {longer}" if longer and document["outcome"] == "budget_spent" else "")

    def _judging(self) -> str:
        """The recording, read as the fit read it, and of it what was held out."""
        asked = self._asked
        first = (*asked.problem.validation, *asked.recordings)[0]
        words = [f"real={shlex.quote(first.source)}"]
        if asked.driven:
            words.append(f"driven=[{','.join(asked.driven)}]")
        words += [shlex.quote(w) for w in self._composition.overrides if w.startswith("data.")]
        parted = asked.problem.validation and first.source == asked.recordings[0].source
        if parted and not any(w.startswith("data.start=") for w in words):
            words.append(f"data.start={first.time[0]:g}")
        return " ".join(words)

    @property
    def _resumable(self) -> bool:
        from trms_cli.commands.identify_progress import STATE_NAME

        return (self._folder / STATE_NAME).is_file()

    def _job_line(self, document: Mapping[str, Any]) -> str:
        part = "held_out" if document["errors"]["held_out"]["after"] else "fit"
        errors = document["errors"][part]["after"] or {}
        figures = ", ".join(f"{n} {_number(e['rmse'])} {e['unit']}" for n, e in errors.items())
        what = " ".join(self._composition.overrides)
        return (
            f"{self._composition.job:>4}  {what}  {document['seconds']['fit']:.1f} s, cost "
            f"{document['cost']:.6g}, {_PARTS[part].removeprefix('on ')}: RMSE {figures}"
        )


def _part(dataset: Dataset) -> str:
    return (
        f"{dataset.name} {dataset.time[0]:g} to {dataset.time[-1] + dataset.sample_time:g} s "
        f"at {1 / dataset.sample_time:g} Hz"
    )


def _more(method: Mapping[str, Any]) -> str:
    for key in ("generations", "evaluations", "iterations"):
        if isinstance(method.get(key), int):
            return f"method.{key}={2 * method[key]}"
    return ""


def _parameter_lines(parameters: Mapping[str, Any]) -> Iterator[str]:
    if not parameters:
        return
    width = max(12, *(len(name) for name in parameters)) + 2
    yield f"{'parameters':{width}}{'fitted':>11}{'±':>10}{'before':>12}{'±':>10}  unit"
    for name, p in parameters.items():
        sd = _number(p["sd"])
        prior = "free" if p["prior_sd"] is None else _number(p["prior_sd"])
        bound = f"  at its {p['at_bound']} bound" if p["at_bound"] else ""
        yield (
            f"  {name:{width - 2}}{_value(p['value']):>11}{sd:>10}"
            f"{_value(p['prior_mean']):>12}{prior:>10}  {p['unit'] or '1'}{bound}"
        )


def _doubt_lines(document: Mapping[str, Any]) -> Iterator[str]:
    """What cannot be told apart, what the data are silent on, and what is at a bound."""
    known = document.get("identifiability") or {}
    sets = known.get("confounded", [])
    for found in sets[:_MOST_SETS]:
        yield (
            f"confounded {', '.join(found['names'])}: these data tell only a combination of them"
        )
    if len(sets) > _MOST_SETS:
        left = len(sets) - _MOST_SETS
        yield f"           and {left} more set{'s' if left > 1 else ''}: see identification.json"
    vague = known.get("uninformed", [])
    if vague:
        yield f"unknown    {', '.join(vague)}: the data say next to nothing; the prior decided"
    absent = [n for n, p in document["parameters"].items() if _absent(n, p)]
    if absent:
        yield f"absent     {', '.join(absent)}: of size zero, these data show none of it"
    far = {n: _moved(p) for n, p in document["parameters"].items() if _moved(p) > _FAR}
    if far:
        listed = ", ".join(f"{name} ({moved:.0f})" for name, moved in far.items())
        yield f"far        {listed}: so many prior deviations from what was known; it may stand for"
        yield "           something that the model lacks, or the record is not what it seems"
    bound = [n for n, p in document["parameters"].items() if p["at_bound"] and n not in absent]
    if bound:
        yield f"at bounds  {', '.join(bound)}: widen bounds.NAME, or ask what the model lacks"
    if document["details"].get("starts_agree") is False:
        yield "starts     did not agree: there is more than one optimum; the best is kept"
    if document["outcome"] != "converged" and any(
        p["sd"] is not None for p in document["parameters"].values()
    ):
        yield "doubt      the search had not settled: the ± do not tell how far it still had to go"
    worse = [
        name
        for name, after in (document["errors"]["held_out"]["after"] or {}).items()
        if (was := (document["errors"]["held_out"]["before"] or {}).get(name, {}).get("rmse"))
        and after["rmse"] is not None
        and after["rmse"] > _WORSE * was
    ]
    if worse:
        yield f"worse      {', '.join(worse)}, on what was held out, than before: ask what it lacks"


def _moved(parameter: Mapping[str, Any]) -> float:
    """By how many prior deviations a parameter moved, 0 where it has no prior."""
    if parameter["prior_sd"] is None or parameter["value"] is None:
        return 0.0
    return abs(float(parameter["value"] - parameter["prior_mean"])) / float(parameter["prior_sd"])


def _absent(name: str, parameter: Mapping[str, Any]) -> bool:
    """Whether it is the size of an effect, and zero."""
    return "." in name and parameter["at_bound"] == "lower" and parameter["lower"] == 0


def _error_lines(errors: Mapping[str, Any]) -> Iterator[str]:
    yield f"{'free runs, RMSE':34}{'before':>10}{'fitted':>10}{'fit %':>9}  unit"
    for part, words in _PARTS.items():
        after, before = errors[part]["after"], errors[part]["before"] or {}
        for name, figures in (after or {}).items():
            was = before.get(name, {}).get("rmse")
            yield (
                f"  {name:9} {words:22}{_number(was):>10}{_number(figures['rmse']):>10}"
                f"{_percent(figures['fit_percent']):>9}  {figures['unit']}"
            )


def _value(value: float | None) -> str:
    return "–" if value is None else f"{value:.5g}"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _percent(value: float | None) -> str:
    """A model that runs away fits by minus many digits, which no column holds."""
    if value is None:
        return "–"
    return f"{value:.1f}" if value > -1e5 else f"{value:.0e}"


def _print_headed(line: str) -> None:
    """The first word bold on a terminal."""
    head = line[:10].rstrip()
    if head and not head.startswith(" ") and _has_colour():
        line = f"\033[1m{head}\033[0m{line[len(head) :]}"
    print(line)


def _has_colour() -> bool:
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return False
    return sys.stdout.isatty()
