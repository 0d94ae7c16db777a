"""What every effect of the library is worth to a controller that knows it, in simulation.

The rig is the model with one effect of its option's size, and the sensors of the simulated rig. It
is controlled twice with the same noise: by the nominal model, and by the model with that effect.
Nothing is identified, so that the study tells what a correction gives where the diagnosis is right,
and finds the controllers and references that a better model makes worse.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.stats import t as student

from trms_cli.composition.composer import compose
from trms_cli.core.errors import TrmsError
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.effects.extended_model import extend_model
from trms_cli.gap import worth
from trms_cli.library.tasks.experiment import experiment_of
from trms_cli.plants.plant import PlantRun
from trms_cli.simulation.closed_loop import Experiment, Loop
from trms_cli.simulation.history import History

FloatArray = npt.NDArray[np.float64]
Report = Callable[[str], None]

NOMINAL, CORRECTED = "nominal", "corrected"
CONTROLLERS = ("newton_mpc", "pid", "linear_mpc", "lqr")
#: Overrides of `trms run` by reference; those with a preview are for controllers that have one.
REFERENCES: Mapping[str, Sequence[str]] = {
    "square": (),
    "limited square": ("shaping@ref.shaping=limited",),
    "sine": ("ref=sine",),
}
_PREVIEW = {"limited square": "controller.preview_horizon=40"}
_PREVIEWING = ("newton_mpc", "linear_mpc")
#: Share by which an error may grow before the corrected model counts as worse.
TOLERANCE = 0.02
#: rad; errors at rest that differ by less are the sensors' quanta.
_VISIBLE = 1e-3
#: s of a run, s at its beginning that are not counted, s after which a reference has been still,
#: and s before its next change that a controller with preview uses.
_DURATION, _RISING, _SETTLED, _AHEAD = 60.0, 10.0, 7.0, 4.0


@dataclass(frozen=True)
class EffectRun:
    """One controlled run."""

    effect: str
    controller: str
    reference: str
    model: str  #: Of the controller and the observer: ``nominal`` or ``corrected``
    seed: int
    error: float  #: rad; root of the mean square of both axes' errors, from the rise on
    #: rad; the same where the reference has stood still, and no change is in view; NaN without such
    holding: float


@dataclass(frozen=True)
class Comparison:
    """An effect under one controller and reference: the corrected model over the nominal one."""

    effect: str
    controller: str
    reference: str
    seeds: int
    error: tuple[float, float]  #: Of the nominal model and the corrected one, rad
    holding: tuple[float, float]  #: Likewise
    ratio: float  #: Geometric mean over the seeds
    ratio_interval: tuple[float, float]  #: 95 %, Student's t on logarithms; NaN of one seed
    holding_ratio: float

    @property
    def is_worse(self) -> bool:
        """Whether the corrected model follows or holds worse than tolerated."""
        held_worse = self.holding_ratio > 1 + TOLERANCE
        visible = self.holding[1] - self.holding[0] > _VISIBLE
        return self.ratio > 1 + TOLERANCE or (held_worse and visible)


def library_effects() -> list[str]:
    """Options of the group effect that a diagnosis may name."""
    options = sorted(path.stem for path in (config_folder() / "effect").glob("*.yaml"))
    config = compose([f"effect=[{','.join(options)}]", "picture=false"]).config["effect"]
    return [name for name in options if build(config[name], f"effect.{name}").explains]


def compare_effects(
    effects: Sequence[str],
    controllers: Sequence[str],
    references: Sequence[str],
    seeds: Sequence[int],
    out: Path,
    report: Report,
) -> list[EffectRun]:
    """All runs; those that the folder holds are not made again."""
    out.mkdir(parents=True, exist_ok=True)
    runs = []
    cases = [
        (seed, effect, controller, reference)
        for seed in seeds
        for effect in effects
        for controller in controllers
        for reference in references
    ]
    for k, (seed, effect, controller, reference) in enumerate(cases, start=1):
        file = out / f"{effect}-{controller}-{reference.replace(' ', '_')}-{seed}.json"
        if not file.exists():
            report(f"{k} of {len(cases)}: {effect}, {controller}, {reference}, seed {seed}")
            pair = _pair(effect, controller, reference, seed)
            file.write_text(json.dumps([asdict(run) for run in pair]), encoding="utf-8")
        runs += [EffectRun(**run) for run in json.loads(file.read_text(encoding="utf-8"))]
    return runs


def _pair(effect: str, controller: str, reference: str, seed: int) -> list[EffectRun]:
    """The run with the nominal model and that with the effect in it."""
    words = [f"effect=[{effect}]", f"controller={controller}", *REFERENCES[reference]]
    if controller in _PREVIEWING and reference in _PREVIEW:
        words.append(_PREVIEW[reference])
    words += [f"sim.duration={_DURATION:g}", f"seed={seed}", "picture=false"]
    experiment = experiment_of(compose(words).config)
    corrected = extend_model(experiment.model, experiment.plant.effects)  # type: ignore[attr-defined]
    pair = []
    for name, model in ((NOMINAL, experiment.model), (CORRECTED, corrected)):
        error, holding = errors_of(replace(experiment, model=model))
        pair.append(EffectRun(effect, controller, reference, name, seed, error, holding))
    return pair


def errors_of(experiment: Experiment) -> tuple[float, float]:
    """Errors of a run, rad: overall and holding; infinite where the loop cannot be closed."""
    controlled = experiment.model.controlled

    def make_history(plant: PlantRun) -> History:
        fields = {"/reference": controlled, "/plant/state": [s.name for s in plant.states]}
        return History({topic: dict.fromkeys(f, "") for topic, f in fields.items()}, None)

    try:
        with np.errstate(all="ignore"):
            loop = Loop.start(replace(experiment, prediction_every=0), make_history)
            loop.run()
    except (TrmsError, ArithmeticError, ValueError, np.linalg.LinAlgError):
        return np.inf, np.inf
    columns = [loop.history.columns(topic) for topic in ("/reference", "/plant/state")]
    reference, state = (np.column_stack([c[name] for name in controlled]) for c in columns)
    times = np.asarray(loop.history.times("/reference"))
    counted = times >= _RISING
    still = counted & has_been_still(reference, experiment.sample_time, loop.preview > 0)
    return _rms(state[counted] - reference[counted]), _rms(state[still] - reference[still])


def has_been_still(reference: FloatArray, step: float, previewed: bool) -> npt.NDArray[np.bool_]:
    """Where no reference has changed for long, nor, if it is known ahead, will soon, (n,)."""
    changes = np.any(np.diff(reference, axis=0, prepend=reference[:1]) != 0, axis=1)
    count = np.cumsum(changes)
    waited = round(_SETTLED / step)
    before = np.concatenate([np.full(waited, -1), count[:-waited]])
    still = count == before
    if previewed:
        ahead = round(_AHEAD / step)
        still &= np.concatenate([count[ahead:], np.full(ahead, count[-1])]) == count
    return still


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))) if len(errors) else float("nan")


def comparisons(runs: Sequence[EffectRun]) -> list[Comparison]:
    """The runs, pair by pair, over their seeds."""
    cases = dict.fromkeys((run.effect, run.controller, run.reference) for run in runs)
    results = []
    for case in cases:
        mine = [r for r in runs if (r.effect, r.controller, r.reference) == case]
        nominal, corrected = (
            sorted((r for r in mine if r.model == model), key=lambda r: r.seed)
            for model in (NOMINAL, CORRECTED)
        )
        ratio, interval = _ratio([r.error for r in nominal], [r.error for r in corrected])
        held, _ = _ratio([r.holding for r in nominal], [r.holding for r in corrected])
        error, holding = (
            (_mean(nominal, name), _mean(corrected, name)) for name in ("error", "holding")
        )
        results.append(Comparison(*case, len(nominal), error, holding, ratio, interval, held))
    return results


def _mean(runs: Sequence[EffectRun], name: str) -> float:
    return float(np.mean([getattr(run, name) for run in runs]))


def _ratio(
    nominal: Sequence[float], corrected: Sequence[float]
) -> tuple[float, tuple[float, float]]:
    """Geometric mean of the corrected errors over the nominal ones, and its 95 % interval."""
    with np.errstate(all="ignore"):
        logs = np.log(np.array(corrected) / np.array(nominal))
    mean, n = float(np.mean(logs)), len(logs)
    half = float("nan")
    if n > 1:
        half = float(student.ppf(0.975, n - 1) * np.std(logs, ddof=1) / np.sqrt(n))
    return float(np.exp(mean)), (float(np.exp(mean - half)), float(np.exp(mean + half)))


def warned_of(effects: Sequence[str], report: Report) -> set[tuple[str, str, str]]:
    """Of which loops ``trms diagnose`` warns: effect, controller and reference.

    As it judges a correction: the corrected model is the rig, on references of the largest
    amplitudes. Of squares the rest counts, too.
    """
    warned = set()
    sines = {axis: (amplitude, 0.0) for axis, amplitude in worth.LARGEST.items()}
    for k, effect in enumerate(effects, start=1):
        report(f"{k} of {len(effects)}: the loops of a diagnosis that names {effect}")
        loops = {}
        for controller in worth.JUDGED_CONTROLLERS:
            references = worth.judged_references(sines, controller)
            for name, words in references.items():
                words = [f"effect=[{effect}]", f"controller={controller}", *words]
                words += [f"sim.duration={worth.DURATION:g}", "picture=false"]
                experiment = experiment_of(compose(words).config)
                nominal, rig = experiment.model, experiment.plant
                corrected = extend_model(nominal, rig.effects)  # type: ignore[attr-defined]
                loops[controller, name] = replace(experiment, model=corrected)
        for gain in worth.loops_of(loops, nominal):
            if gain.is_worse:
                reference = {"rest": "square"}.get(gain.reference, gain.reference)
                warned.add((effect, gain.controller, reference.replace("_", " ")))
    return warned


def tables(
    results: Sequence[Comparison], warned: Collection[tuple[str, str, str]]
) -> dict[str, list[list[str]]]:
    """Those that are worse, and a line for each controller and reference.

    ``warned``: of which loops a diagnosis warns (:func:`warned_of`).
    """
    worse = [result for result in results if result.is_worse]
    return {"every_effect": _summary(results), "every_effect_worse": _table(worse, warned)}


def _summary(results: Sequence[Comparison]) -> list[list[str]]:
    """How the ratios of the effects lie, by controller and reference."""
    head = ["controller", "reference", "effects", "ratio: least", "median", "largest", "worse"]
    rows = [head]
    for controller, reference in dict.fromkeys((r.controller, r.reference) for r in results):
        mine = [r for r in results if (r.controller, r.reference) == (controller, reference)]
        ratios = np.array([r.ratio for r in mine])
        quantiles = [f"{v:.3f}" for v in np.nanquantile(ratios, [0.0, 0.5, 1.0], method="nearest")]
        worse = str(sum(r.is_worse for r in mine))
        rows.append([controller, reference, str(len(mine)), *quantiles, worse])
    return rows


def _table(
    results: Sequence[Comparison], warned: Collection[tuple[str, str, str]]
) -> list[list[str]]:
    """Comparisons as rows, the worst first."""
    head = ["effect", "controller", "reference", "error, nominal → corrected [mrad]"]
    head += ["ratio", "holding [mrad]", "ratio", "seeds", "a diagnosis warns"]
    rows = [head]
    for r in sorted(results, key=lambda r: -r.ratio if np.isfinite(r.ratio) else -np.inf):
        low, high = r.ratio_interval
        spread = "" if np.isnan(low) else f" [{low:.3f}, {high:.3f}]"
        is_held = not np.isnan(r.holding[0])
        holding = f"{1e3 * r.holding[0]:.1f} → {1e3 * r.holding[1]:.1f}" if is_held else "–"
        held_ratio = f"{r.holding_ratio:.2f}" if is_held else "–"
        error = f"{1e3 * r.error[0]:.1f} → {1e3 * r.error[1]:.1f}"
        first = [f"`{r.effect}`", r.controller, r.reference, error, f"{r.ratio:.3f}{spread}"]
        warns = "yes" if (r.effect, r.controller, r.reference) in warned else "no"
        rows.append([*first, holding, held_ratio, str(r.seeds), warns])
    return rows
