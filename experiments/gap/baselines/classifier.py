"""A classifier trained on synthetic rigs: multinomial logistic regression on a residual's marks.

Thousands of rigs are drawn from the priors, each with one effect of the library or none, driven by
random commands, and simulated with the library's own code. Of each recording the restoring force
beyond the nominal model is taken, what parameters can add within their priors projected out, and
described by energies, bands, and correlations with the terms of :mod:`.force_terms`, derivatives
and commands. Rigs of a sealed set have no part in the training; their code is another.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import numpy as np

from experiments.command_line import process_pool
from experiments.gap.baselines.baseline import diagnosis, places
from experiments.gap.baselines.fits import (
    is_size,
    nominal_free,
    parts_of,
    refit,
)
from experiments.gap.baselines.force_terms import columns
from experiments.gap.baselines.restoring_force import motion
from experiments.gap.baselines.white_noise import fit_with
from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import cache_folder
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import extend_model
from trms_cli.gap.diagnosis import Cause, DiagnosisResult
from trms_cli.gap.problem import GapProblem, applicable_candidates
from trms_cli.gap.shrinkage import measure_shrinkage
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model, index_of, names
from trms_cli.models.parameters import Parameter
from trms_cli.models.rest import resting_state
from trms_cli.plants.sensors import noise_estimate
from trms_cli.simulation.rollout import Rollout

#: s, of a training recording, and what is left out at its beginning.
_DURATION, _SETTLING = 40.0, 3.0
#: Share of a command's limit about which it moves, and by which, by rotor.
_CENTRE, _SWING = {"main": 0.5, "tail": 0.0}, {"main": 0.18, "tail": 0.36}
#: Hz and s: lines of the waves, holding times of the levels.
_BAND, _LINES, _HOLD = (0.02, 1.2), 24, (1.0, 5.0)
#: Encoder's and tacho's quanta and the tacho's noise, as the bench declares them.
_ENCODER, _TACHO, _TACHO_NOISE = 2 * np.pi / 4096, 0.49, 1.6
#: rad. A rig that swings farther is none.
_FARTHEST = 2.5
_FARTHEST_SD = 2.5


@dataclass(frozen=True)
class Request:
    """Rigs of one class."""

    model: Model  #: The nominal one
    name: str
    effect: Effect | None
    outputs: tuple[str, ...]
    sample_time: float  #: s
    count: int
    seed: int


def rigs(request: Request) -> FloatArray:
    """Marks of the rigs of a class, (up to count, n); a rig that ran away is left out."""
    model = request.model
    rig = model if request.effect is None else extend_model(model, {request.name: request.effect})
    rollout = Rollout(rig, request.sample_time)
    random = np.random.default_rng(np.random.SeedSequence([0xC1A5, request.seed]))
    rows = []
    for _ in range(request.count):
        dataset = _recorded(request, rig, rollout, random)
        if dataset is not None:
            rows.append(marks(model, [dataset], 10.0))
    return np.array(rows)


def _recorded(
    request: Request, rig: Model, rollout: Rollout, random: np.random.Generator
) -> Dataset | None:
    model, step = request.model, request.sample_time
    skipped = round(_SETTLING / step)
    u = _commands(model, round(_DURATION / step) + skipped, step, random)
    p = _draw(rig, random)
    start = rollout.initial(resting_state(rig, {}, u[0]), u[0])
    with np.errstate(all="ignore"):
        y = rollout.outputs(u, [0], [len(u)], start[None], p).y[skipped:]
    columns = [index_of(model.outputs, name, "an output") for name in request.outputs]
    y, outputs, sd = y[:, columns], tuple(model.outputs[i] for i in columns), []
    for i, signal in enumerate(outputs):
        if not np.isfinite(y[:, i]).all():
            return None
        if signal.unit == "rad":
            if np.abs(y[:, i]).max() > _FARTHEST:
                return None
            quantum, noise = _ENCODER, 0.0
        else:
            quantum, noise = _TACHO, _TACHO_NOISE
        y[:, i] = quantum * np.round((y[:, i] + noise * random.standard_normal(len(y))) / quantum)
        sd.append(float(np.hypot(noise, quantum / 12**0.5)))
    commands = np.ascontiguousarray(u[skipped:])
    time: FloatArray = step * np.arange(len(y), dtype=float)
    return Dataset(
        "synthetic", "", "0" * 64, step, time, model.inputs, outputs, commands, y, np.array(sd)
    )


def _commands(model: Model, samples: int, step: float, random: np.random.Generator) -> FloatArray:
    """Sums of sines with held random levels, within the limits."""
    time, columns = step * np.arange(samples), []
    for signal in model.inputs:
        rotor = next((n for n, r in model.rotors.items() if r.input == signal.name), "tail")
        limit = model.input_limits[signal.name]
        lines = np.exp(random.uniform(np.log(_BAND[0]), np.log(_BAND[1]), _LINES))
        phases = random.uniform(0, 2 * np.pi, _LINES)
        waves = np.sin(2 * np.pi * np.outer(time, lines) + phases).sum(axis=1)
        waves /= np.sqrt(_LINES / 2)
        levels, at = np.empty(samples), 0
        while at < samples:
            hold = max(1, round(random.uniform(*_HOLD) / step))
            levels[at : at + hold] = random.uniform(-1, 1)
            at += hold
        swing = _SWING.get(rotor, 0.3) * random.uniform(0.6, 1.1)
        centre = _CENTRE.get(rotor, 0.0) * random.uniform(0.95, 1.05)
        u = centre + 0.5 * swing * (waves + levels)
        columns.append(limit * np.clip(u, -1, 1))
    return np.stack(columns, axis=1)


def _draw(rig: Model, random: np.random.Generator) -> FloatArray:
    """All parameters of a rig: the nominal ones from their priors, sizes from their ranges."""
    p, order = rig.parameters.values, rig.parameters.names
    scatter = random.uniform(0.0, 1.0)
    for free in nominal_free(rig):
        z = np.clip(random.standard_normal(), -_FARTHEST_SD, _FARTHEST_SD)
        value = free.prior_mean + scatter * free.scale * z
        p[order.index(free.name)] = np.clip(value, free.lower, free.upper)
    for parameter in rig.parameters:
        if is_size(parameter.name) and parameter.prior_sd is None:
            p[order.index(parameter.name)] = _size(parameter, random)
    return p


def _size(parameter: Parameter, random: np.random.Generator) -> float:
    """Over its typical range: by factors where it has one sign, evenly where it has two."""
    if parameter.typical is None:
        return parameter.value * float(np.exp(random.uniform(-1, 1)))
    low, high = parameter.typical
    if low > 0:
        value = float(np.exp(random.uniform(np.log(low), np.log(high))))
    else:
        value = float(random.uniform(low, high))
    return float(np.clip(value, parameter.lower, parameter.upper))


#: Edges of the bands of the force's spectrum, Hz.
_BANDS = (0.0, 0.3, 1.0, 2.0, 4.0, 8.0)


def marks(model: Model, datasets: Sequence[Dataset], block: float) -> FloatArray:
    """Marks of one rig's recordings, (n,): of the same length for the same model and channels.

    For each equation: logarithm of the force's size beyond what the parameters explain, shares of
    bands, and its correlation with the library's terms, with derivatives of the states, and with
    the commands; for each channel the size of its steps and of its noise.
    """
    free = nominal_free(model)
    trajectory = motion(model, datasets, [p.name for p in free], block)
    terms, library = columns(model, trajectory)
    scales = np.array([p.scale for p in free])
    derivative = np.gradient(trajectory.x, trajectory.step, axis=0)
    second = np.gradient(derivative, trajectory.step, axis=0)
    slopes = np.gradient(trajectory.u, trajectory.step, axis=0)
    common = np.hstack(
        [trajectory.x, derivative, second, trajectory.u, slopes, np.ones((len(trajectory.x), 1))]
    )
    features: list[float] = []
    for i, place in enumerate(names(model.disturbances)):
        force = trajectory.force[:, i]
        nuisances = trajectory.of_parameters[:, i] * scales
        ridge = float(np.var(force)) * len(force) / trajectory.independent
        inner = nuisances.T @ nuisances + ridge * np.eye(len(free))
        gain = np.linalg.solve(inner, nuisances.T) if len(free) else nuisances.T
        term_columns = [k for k, term in enumerate(terms) if term.location == place]
        both = np.hstack([force[:, None], library[:, term_columns], common])
        residuals = both - nuisances @ (gain @ both)
        size = np.sqrt(np.mean(residuals**2, axis=0))
        unit = residuals / np.maximum(size, 1e-12 + 1e-6 * np.sqrt(np.mean(both**2, axis=0)))
        features.append(float(np.log(size[0] + 1e-12)))
        features.append(float(np.log(size[0] / (np.sqrt(np.mean(force**2)) + 1e-12) + 1e-6)))
        features += _bands(residuals[:, 0], trajectory.step)
        features += (unit[:, 1:].T @ unit[:, 0] / len(unit)).tolist()
    for signal_noise in _of_channels(datasets):
        features += signal_noise
    values = np.nan_to_num(np.array(features), nan=0.0, posinf=0.0, neginf=0.0)
    return values


def _bands(force: FloatArray, step: float) -> list[float]:
    """Logarithms of the shares of bands."""
    power = np.abs(np.fft.rfft(force - force.mean())) ** 2
    frequency = np.fft.rfftfreq(len(force), step)
    total = float(power.sum()) + 1e-300
    return [
        float(np.log(power[(frequency >= low) & (frequency < high)].sum() / total + 1e-6))
        for low, high in pairwise(_BANDS)
    ]


def _of_channels(datasets: Sequence[Dataset]) -> list[list[float]]:
    """Logarithms of each channel's noise and typical step, over the declared noise."""
    rows = []
    for i, sd in enumerate(datasets[0].noise_sd):
        values = np.concatenate([d.measurements[:, i] for d in datasets])
        noise = float(noise_estimate(values[:, None])[0])
        steps = np.abs(np.diff(values))
        steps = steps[np.isfinite(steps) & (steps > 1e-9)]
        step = float(np.median(steps)) if steps.size else 0.0
        least = float(np.min(steps)) if steps.size else 0.0
        unit = max(float(sd), 1e-9)
        rows.append([float(np.log(v / unit + 1e-2)) for v in (noise, step, least)])
    return rows


#: Rigs of each class, and the share that the ridge is chosen on.
RIGS, _VALIDATION_SHARE = 40, 0.2
#: Rigs without effect, as a multiple of those of an effect.
_PLAIN = 4
_RIDGES = (0.3, 3.0, 30.0)
NO_EFFECT = "parameters_only"
#: A class that is less likely than this is not decided for.
_LIKELY = 0.5
#: Causes of less probability are not told.
_LEAST_PROBABILITY = 1e-3


@dataclass(frozen=True)
class TrainedClassifier:
    """A trained classifier."""

    classes: tuple[str, ...]
    mean: FloatArray  #: (n,) arrays; of the marks
    sd: FloatArray  #: (n,) arrays; of the marks
    weights: FloatArray  #: (classes, n + 1) array
    accuracy: float  #: On rigs that the weights were not fitted to

    def probabilities(self, features: FloatArray) -> FloatArray:
        """Of each class, for marks (k, n)."""
        return _softmax(_design((features - self.mean) / self.sd) @ self.weights.T)


@dataclass(frozen=True, kw_only=True)
class Classifier:
    """Names the effect whose synthetic rigs look like the recording; fits it for the shrink."""

    name: ClassVar[str] = "classifier"

    def answer(self, problem: GapProblem) -> DiagnosisResult:
        """See :class:`~experiments.gap.baselines.baseline.Baseline`."""
        start_time = time.perf_counter()
        parts = parts_of(problem)
        model = train_classifier(
            problem.model,
            problem.candidates,
            names(problem.datasets[0].outputs),
            parts.whole[0].sample_time,
            jobs=problem.jobs,
        )
        features = marks(problem.model, parts.fitted, parts.block)
        probabilities = model.probabilities(features[None])[0]
        order = np.argsort(-probabilities, kind="stable")
        best = model.classes[int(order[0])]
        plain = refit(problem, parts)
        corrected, selected_candidates = plain, []
        candidates, _ = applicable_candidates(problem.model, problem.candidates)
        likely = float(probabilities[order[0]]) >= _LIKELY
        if best in candidates and likely:
            selected_candidates = [candidates[best]]
            corrected = fit_with(problem, parts, selected_candidates)
        return diagnosis(
            problem,
            "effect" if selected_candidates else "parameters_only" if likely else "undecided",
            [
                Cause(
                    effects=(model.classes[i],),
                    probability=float(probabilities[i]),
                    parameters=corrected.sizes() if model.classes[i] == best else {},
                )
                for i in order
                if probabilities[i] > _LEAST_PROBABILITY
            ],
            measure_shrinkage(problem, parts, problem.model, plain.model, corrected.model),
            where=places(selected_candidates, 1.0),
            parameters=corrected.nominal(),
            refit=plain.values,
            sentence=f"The recording looks like those of synthetic rigs with {best}.",
            seconds={"all": time.perf_counter() - start_time},
        )


def train_classifier(
    model: Model,
    candidates: Mapping[str, Effect],
    outputs: Sequence[str],
    sample_time: float,
    *,
    rigs_each: int = RIGS,
    jobs: int = 2,
    tell: Callable[[str], None] = lambda line: None,
) -> TrainedClassifier:
    """The classifier for such recordings, from the cache folder if it was trained before.

    Parameters
    ----------
    outputs : sequence of str
        Channels of the recordings.
    sample_time : float
        s.
    rigs_each : int
        Rigs of each effect.
    jobs : int
        Processes.
    tell : callable
        Told a line an effect.
    """
    applicable_effects, _ = applicable_candidates(model, candidates)
    effects = {name: s.effect for name, s in applicable_effects.items() if not s.stochastic}
    file = _file(model, effects, outputs, sample_time, rigs_each)
    if file.is_file():
        with np.load(file) as archive:
            return TrainedClassifier(
                tuple(archive["classes"].tolist()),
                archive["mean"],
                archive["sd"],
                archive["weights"],
                float(archive["accuracy"]),
            )
    requests = [
        Request(model, name, effect, tuple(outputs), sample_time, rigs_each, seed)
        for seed, (name, effect) in enumerate(effects.items(), start=1)
    ]
    requests += [
        Request(model, NO_EFFECT, None, tuple(outputs), sample_time, rigs_each, 10_000 + k)
        for k in range(_PLAIN)
    ]
    labels, rows = [], []
    for request, class_features in zip(requests, _simulate_features(requests, jobs), strict=True):
        tell(f"{request.name}: {len(class_features)} rigs")
        labels += [request.name] * len(class_features)
        rows.append(class_features)
    model_ = _fitted(labels, np.concatenate(rows))
    file.parent.mkdir(parents=True, exist_ok=True)
    draft = file.with_suffix(".draft.npz")
    np.savez(
        draft,
        classes=np.array(model_.classes),
        mean=model_.mean,
        sd=model_.sd,
        weights=model_.weights,
        accuracy=model_.accuracy,
    )
    draft.replace(file)
    return model_


def _simulate_features(requests: Sequence[Request], jobs: int) -> list[FloatArray]:
    if jobs == 1:
        return [rigs(request) for request in requests]
    with process_pool(jobs) as pool:
        return list(pool.map(rigs, requests))


def _file(
    model: Model,
    candidates: Mapping[str, Effect],
    outputs: Sequence[str],
    sample_time: float,
    count: int,
) -> Path:
    key_parts = [f"{p.name} {p.value!r} {p.prior_sd!r}" for p in model.parameters]
    key_parts += [f"{name} {effect!r}" for name, effect in candidates.items()]
    key_parts += [type(model).__qualname__, repr((tuple(outputs), sample_time, count, "marks 1"))]
    digest = hashlib.sha256("\n".join(key_parts).encode()).hexdigest()[:16]
    return cache_folder().parent / "baselines" / f"classifier-{digest}.npz"


def _fitted(labels: Sequence[str], values: FloatArray) -> TrainedClassifier:
    """Ridge by rigs held out, then all."""
    classes = tuple(sorted(set(labels)))
    target = np.array([classes.index(label) for label in labels])
    mean, sd = values.mean(axis=0), np.maximum(values.std(axis=0), 1e-9)
    design = _design((values - mean) / sd)
    is_validation = np.random.default_rng(0).random(len(target)) < _VALIDATION_SHARE
    scores = {}
    for ridge in _RIDGES:
        weights = _logistic(design[~is_validation], target[~is_validation], len(classes), ridge)
        predictions = np.argmax(design[is_validation] @ weights.T, axis=1)
        scores[ridge] = float(np.mean(predictions == target[is_validation]))
    best = max(scores, key=lambda ridge: scores[ridge])
    weights = _logistic(design, target, len(classes), best)
    return TrainedClassifier(classes, mean, sd, weights, scores[best])


def _design(z: FloatArray) -> FloatArray:
    """Marks within four standard deviations, their sizes, and 1."""
    z = np.clip(z, -4.0, 4.0)
    return np.hstack([z, np.abs(z), np.ones((len(z), 1))])


def _softmax(scores: FloatArray) -> FloatArray:
    e = np.exp(scores - scores.max(axis=1, keepdims=True))
    shares: FloatArray = e / e.sum(axis=1, keepdims=True)
    return shares


def _logistic(design: FloatArray, target: FloatArray, classes: int, ridge: float) -> FloatArray:
    """Multinomial logistic regression with a ridge, by L-BFGS."""
    from scipy.optimize import minimize

    one_hot = np.eye(classes)[target]

    def cost(flat: FloatArray) -> tuple[float, FloatArray]:
        weights = flat.reshape(classes, -1)
        shares = _softmax(design @ weights.T)
        value = -float(np.sum(one_hot * np.log(np.maximum(shares, 1e-300))))
        slope = (shares - one_hot).T @ design + ridge * weights
        return value + 0.5 * ridge * float(np.sum(weights**2)), slope.ravel()

    start = np.zeros(classes * design.shape[1])
    solution = minimize(cost, start, jac=True, method="L-BFGS-B", options={"maxiter": 150})
    weights: FloatArray = solution.x.reshape(classes, -1)
    return weights
