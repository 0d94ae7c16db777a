"""A baseline over a sealed set: a folder of diagnoses that ``trms blind score`` takes.

Each recording is answered in a process of its own, in one thread; what has an answer is not done
again. Only methods of :data:`WITH_KEY` may open the key.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from experiments.command_line import side_by_side
from experiments.gap.baselines.baseline import Baseline
from experiments.gap.baselines.oracle import RigTruth
from experiments.gap.blind.judgement import CORRECTED, REFIT
from experiments.gap.blind.run import recordings_of
from experiments.gap.blind.sealing import open_key
from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.core.plugins import build, nearest
from trms_cli.core.resources import config_folder
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import extend_model
from trms_cli.gap.diagnosis import NO_EFFECT, DiagnosisResult, document_of
from trms_cli.gap.problem import GapProblem
from trms_cli.identification.model_writer import ModelOrigin, model_document, write_model
from trms_cli.identification.problem import free_parameters
from trms_cli.models.model import Model

#: Recordings that a process answers before another takes its place.
_TASKS = 20


def write_models(answer: DiagnosisResult, problem: GapProblem, folder: Path) -> None:
    """Write the nominal model refitted, and with the first cause's effects.

    An answer whose correction is no effect of the library (a regressed force) leaves none: its
    shrink is what it tells itself.
    """
    first = answer.causes[0] if answer.causes else None
    effects: tuple[str, ...] = ()
    if first is not None and not set(first.effects) & set(NO_EFFECT):
        effects = first.effects if first.parameters else ()
        if answer.verdict == "effect" and not effects:
            return
    elif answer.verdict == "none_of_these" and answer.where:
        return
    refitted = dict(answer.refit)
    _write(answer, problem, (), refitted, folder / REFIT)
    values = {name: p.fitted for name, p in answer.parameters.items()} or refitted
    if first is not None:
        values |= {name: size.value for name, size in first.parameters.items()}
    _write(answer, problem, effects, values, folder / CORRECTED)


def _write(
    answer: DiagnosisResult,
    problem: GapProblem,
    effects: tuple[str, ...],
    values: dict[str, float],
    path: Path,
) -> None:
    effects_by_name = {name: problem.candidates[name] for name in effects}
    nominal = [name for name in values if name in problem.model.parameters]
    model: Model = extend_model(problem.model, effects_by_name)
    document = model_document(
        problem.datasets[0].name,
        model,
        ModelOrigin(
            option=problem.model_name,
            effects={name: arguments_of(effect) for name, effect in effects_by_name.items()},
        ),
        values=values,
        deviations={name: p.sd for name, p in answer.parameters.items() if p.sd == p.sd},
        free=free_parameters(problem.model.parameters, nominal) if nominal else (),
        source="fitted by a baseline on " + ", ".join(d.name for d in problem.datasets),
    )
    write_model(document, path)


def arguments_of(effect: Effect) -> dict[str, Any]:
    """What an effect is made with besides its sizes."""
    sizes = {p.name for p in effect.parameters()}
    own: list[str] = [field.name for field in fields(effect)] if is_dataclass(effect) else []
    return {name: getattr(effect, name) for name in own if name not in sizes}


DOCUMENT = "diagnosis.json"
METHODS = (
    "parameter_refit",
    "sparse_regression",
    "white_noise_bic",
    "classifier",
    "flexible_residual",
    "oracle",
    "true_values",
)
#: Those that know the truth.
WITH_KEY = ("oracle", "true_values")
_NOTHING = RigTruth()
#: What a recording is to be diagnosed as: it is handed to other processes, so no closure.
ProblemOf = Callable[[Path], GapProblem]


def baseline_of(name: str, truth: RigTruth = _NOTHING) -> Baseline:
    """A baseline by name.

    Parameters
    ----------
    name : str
        One of :data:`METHODS`.
    truth : RigTruth
        For those that know it.

    Raises
    ------
    ConfigurationError
        For another name.
    """
    if name == "parameter_refit":
        from experiments.gap.baselines.parameter_refit import ParameterRefit

        return ParameterRefit()
    if name == "sparse_regression":
        from experiments.gap.baselines.sparse_regression import SparseRegression

        return SparseRegression()
    if name == "white_noise_bic":
        from experiments.gap.baselines.white_noise import WhiteNoiseBic

        return WhiteNoiseBic()
    if name == "classifier":
        from experiments.gap.baselines.classifier import Classifier

        return Classifier()
    if name == "flexible_residual":
        from experiments.gap.baselines.flexible_residual import FlexibleResidual

        return FlexibleResidual()
    if name == "oracle":
        from experiments.gap.baselines.oracle import Oracle

        return Oracle(effects=truth.effects)
    if name == "true_values":
        from experiments.gap.baselines.oracle import TrueValues

        return TrueValues(truth=truth)
    raise ConfigurationError(
        f"{name!r} is no baseline", where="method", remedy=nearest(name, METHODS)
    )


def bench_problem(recording: Path) -> GapProblem:
    """A recording as ``trms diagnose real=FILE`` takes it: the Newtonian model, all effects."""
    import yaml

    from trms_cli.identification.data import DataOptions, load_datasets
    from trms_cli.models.newtonian import Newtonian

    text = (config_folder() / "data" / "recording.yaml").read_text(encoding="utf-8")
    options = build(yaml.safe_load(text), "data")
    assert isinstance(options, DataOptions)
    model = Newtonian()
    datasets = tuple(load_datasets(str(recording), model, options))
    return GapProblem(
        model=model, model_name="newtonian", datasets=datasets, candidates=bench_effects(), jobs=1
    )


def bench_effects() -> dict[str, Effect]:
    """Every effect that the package brings as a cause, at its typical size."""
    import yaml

    candidates = {}
    for file in sorted((config_folder() / "effect").glob("*.yaml")):
        for name, node in yaml.safe_load(file.read_text(encoding="utf-8")).items():
            effect = build(node, f"effect.{name}")
            assert isinstance(effect, Effect)
            if effect.explains:
                candidates[name] = effect
    return candidates


def truths_of(key: Path, folder: Path) -> dict[str, RigTruth]:
    """What each rig of a set has, by recording: for those alone that know it."""
    truths = {}
    for name, case in open_key(key, folder).cases.items():
        values = case.parameter_values()
        for effect, sizes in case.effects.items():
            values |= {f"{effect}.{size}": value for size, value in sizes.items()}
        truths[name] = RigTruth(effects=tuple(case.effects), values=values)
    return truths


def run_baseline(
    name: str,
    folder_in: Path,
    folder_out: Path,
    jobs: int = 2,
    *,
    problem_of: ProblemOf = bench_problem,
    truths: Mapping[str, RigTruth] | None = None,
    cases: int | None = None,
    tell: Callable[[str], None] = print,
) -> dict[str, str]:
    """Answer every recording of a set.

    Parameters
    ----------
    name : str
        One of :data:`METHODS`.
    folder_in, folder_out : Path
        Of the set, as ``trms blind make`` wrote it, and of the answers:
        ``<recording>/diagnosis.json``.
    jobs : int
        Recordings at once.
    problem_of : callable
        A function of a module.
    truths : dict of str to RigTruth or None
        By recording, for those that know it; see :func:`truths_of`.
    cases : int or None
        Only the first so many.
    tell : callable
        Told a line a recording.

    Returns
    -------
    dict of str to str
        Why, by name, for those that could not be answered.
    """
    baseline_of(name)
    if name in WITH_KEY and truths is None:
        raise ConfigurationError(f"{name} has to know the truth", where="key", remedy="key=DIR.key")
    recordings = recordings_of(folder_in)[:cases]
    waiting = [r for r in recordings if not (folder_out / r.stem / DOCUMENT).is_file()]
    folder_out.mkdir(parents=True, exist_ok=True)
    failed: dict[str, str] = {}
    start_time = perf_counter()
    known_truths = truths or {}
    tasks = {
        r.stem: (name, known_truths.get(r.stem, _NOTHING), r, folder_out, problem_of)
        for r in waiting
    }
    for count, (stem, future) in enumerate(side_by_side(_answer, tasks, jobs, _TASKS), start=1):
        problem = future.exception()
        if problem is None:
            message = future.result()
        else:
            failed[stem] = message = (
                str(problem) if isinstance(problem, TrmsError) else repr(problem)
            )
        minutes = (perf_counter() - start_time) / 60
        tell(f"{count:4d} of {len(waiting)}  {stem}  {message}  {minutes:.1f} min")
    return failed


def _answer(name: str, truth: RigTruth, recording: Path, out: Path, problem_of: ProblemOf) -> str:
    """One answer; its verdict and first cause."""
    start_time = perf_counter()
    problem = problem_of(recording)
    answer = baseline_of(name, truth).answer(problem)
    draft = out / f".{recording.stem}"
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    text = json.dumps(document_of(answer), indent=1, allow_nan=False)
    (draft / DOCUMENT).write_text(text + "\n", encoding="utf-8")
    write_models(answer, problem, draft)
    seconds = json.dumps({"seconds": round(perf_counter() - start_time, 2)})
    (draft / "blind.json").write_text(seconds + "\n", encoding="utf-8")
    draft.replace(out / recording.stem)
    first = answer.causes[0] if answer.causes else None
    cause_text = f"{'+'.join(first.effects)} {first.probability:.2f}" if first else ""
    return f"{answer.verdict:15}  {cause_text}"
