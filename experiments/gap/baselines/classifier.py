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
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import ClassVar

import numpy as np

from experiments.gap.baselines.baseline import diagnosis, places
from experiments.gap.baselines.fits import fit_problem, map_fit, parts_of, refit
from experiments.gap.baselines.marks import marks
from experiments.gap.baselines.synthetic import Request, rigs
from experiments.gap.baselines.white_noise import compete
from trms_cli.core.compilation import cache_folder
from trms_cli.effects.effect import Effect
from trms_cli.gap.candidates import applicable_candidates
from trms_cli.gap.diagnosis import Cause, Diagnosis
from trms_cli.gap.problem import GapProblem
from trms_cli.gap.shrinkage import measure_shrinkage
from trms_cli.identification.dataset import FloatArray
from trms_cli.models.model import Model, names

#: Rigs of each class, and the share that the ridge is chosen on.
RIGS, _HELD = 40, 0.2
#: Rigs without effect, as a multiple of those of an effect.
_PLAIN = 4
_RIDGES = (0.3, 3.0, 30.0)
NO_EFFECT = "parameters_only"
#: A class that is less likely than this is not decided for.
_LIKELY = 0.5
#: Causes of less probability are not told.
_TOLD = 1e-3


@dataclass(frozen=True)
class Trained:
    """A trained classifier."""

    classes: tuple[str, ...]
    mean: FloatArray  #: (n,) arrays; of the marks
    sd: FloatArray  #: (n,) arrays; of the marks
    weights: FloatArray  #: (classes, n + 1) array
    accuracy: float  #: On rigs that the weights were not fitted to

    def probabilities(self, found: FloatArray) -> FloatArray:
        """Of each class, for marks (k, n)."""
        return _softmax(_design((found - self.mean) / self.sd) @ self.weights.T)


@dataclass(frozen=True, kw_only=True)
class Classifier:
    """Names the effect whose synthetic rigs look like the recording; fits it for the shrink."""

    name: ClassVar[str] = "classifier"

    def answer(self, problem: GapProblem) -> Diagnosis:
        """See :class:`~experiments.gap.baselines.baseline.Baseline`."""
        begun = time.perf_counter()
        parts = parts_of(problem)
        model = trained(
            problem.model,
            problem.candidates,
            names(problem.datasets[0].outputs),
            parts.whole[0].sample_time,
            jobs=problem.jobs,
        )
        told = model.probabilities(marks(problem.model, parts.fitted, parts.block)[None])[0]
        order = np.argsort(-told, kind="stable")
        best = model.classes[int(order[0])]
        plain = refit(problem, parts)
        corrected, chosen = plain, []
        found, _ = applicable_candidates(problem.model, problem.candidates)
        likely = float(told[order[0]]) >= _LIKELY
        if best in found and likely:
            chosen = [found[best]]
            near = compete(problem, parts, chosen, compete(problem, parts, (), None))
            starts: Mapping[str, float] = near.fit.values if np.isfinite(near.bic) else {}
            corrected = map_fit(fit_problem(problem, parts, chosen, starts))
        return diagnosis(
            problem,
            "effect" if chosen else "parameters_only" if likely else "undecided",
            [
                Cause(
                    effects=(model.classes[i],),
                    probability=float(told[i]),
                    parameters=corrected.sizes() if model.classes[i] == best else {},
                )
                for i in order
                if told[i] > _TOLD
            ],
            measure_shrinkage(problem, parts, problem.model, plain.model, corrected.model),
            where=places(chosen, 1.0),
            parameters=corrected.nominal(),
            refit=plain.values,
            sentence=f"The recording looks like those of synthetic rigs with {best}.",
            seconds={"all": time.perf_counter() - begun},
        )


def trained(
    model: Model,
    candidates: Mapping[str, Effect],
    outputs: Sequence[str],
    sample_time: float,
    *,
    rigs_each: int = RIGS,
    jobs: int = 2,
    tell: Callable[[str], None] = lambda line: None,
) -> Trained:
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
    found, _ = applicable_candidates(model, candidates)
    kept = {name: s.effect for name, s in found.items() if not s.stochastic}
    file = _file(model, kept, outputs, sample_time, rigs_each)
    if file.is_file():
        with np.load(file) as saved:
            return Trained(
                tuple(saved["classes"].tolist()),
                saved["mean"],
                saved["sd"],
                saved["weights"],
                float(saved["accuracy"]),
            )
    requests = [
        Request(model, name, effect, tuple(outputs), sample_time, rigs_each, seed)
        for seed, (name, effect) in enumerate(kept.items(), start=1)
    ]
    requests += [
        Request(model, NO_EFFECT, None, tuple(outputs), sample_time, rigs_each, 10_000 + k)
        for k in range(_PLAIN)
    ]
    labels, rows = [], []
    for request, made in zip(requests, _made(requests, jobs), strict=True):
        tell(f"{request.name}: {len(made)} rigs")
        labels += [request.name] * len(made)
        rows.append(made)
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


def _made(requests: Sequence[Request], jobs: int) -> list[FloatArray]:
    if jobs == 1:
        return [rigs(request) for request in requests]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        return list(pool.map(rigs, requests))


def _file(
    model: Model,
    candidates: Mapping[str, Effect],
    outputs: Sequence[str],
    sample_time: float,
    count: int,
) -> Path:
    said = [f"{p.name} {p.value!r} {p.prior_sd!r}" for p in model.parameters]
    said += [f"{name} {effect!r}" for name, effect in candidates.items()]
    said += [type(model).__qualname__, repr((tuple(outputs), sample_time, count, "marks 1"))]
    digest = hashlib.sha256("\n".join(said).encode()).hexdigest()[:16]
    return cache_folder().parent / "baselines" / f"classifier-{digest}.npz"


def _fitted(labels: Sequence[str], values: FloatArray) -> Trained:
    """Ridge by rigs held out, then all."""
    classes = tuple(sorted(set(labels)))
    target = np.array([classes.index(label) for label in labels])
    mean, sd = values.mean(axis=0), np.maximum(values.std(axis=0), 1e-9)
    design = _design((values - mean) / sd)
    held = np.random.default_rng(0).random(len(target)) < _HELD
    scores = {}
    for ridge in _RIDGES:
        weights = _logistic(design[~held], target[~held], len(classes), ridge)
        told = np.argmax(design[held] @ weights.T, axis=1)
        scores[ridge] = float(np.mean(told == target[held]))
    best = max(scores, key=lambda ridge: scores[ridge])
    weights = _logistic(design, target, len(classes), best)
    return Trained(classes, mean, sd, weights, scores[best])


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
    found = minimize(cost, start, jac=True, method="L-BFGS-B", options={"maxiter": 150})
    weights: FloatArray = found.x.reshape(classes, -1)
    return weights
