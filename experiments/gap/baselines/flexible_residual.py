"""A residual force without a name: what learns the gap and does not say what it is.

The force that the refitted model lacks is regressed on the rig's motion by random features, a
layer of tanh with random weights and a ridge on what leaves it (Huang et al. 2006, Neurocomputing
70; the random features of Rahimi & Recht 2007). Width and ridge are chosen by cross-validation
over blocks, for each equation of motion apart; one that is not foretold out of sample gets none.
The learnt force is added to the model like residual dynamics in learning control.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import casadi as ca
import numpy as np

from experiments.gap.baselines.baseline import diagnosis
from experiments.gap.baselines.fits import parts_of, refit
from experiments.gap.baselines.restoring_force import Motion, motion
from trms_cli.core.arrays import FloatArray
from trms_cli.effects.effect import Effect, EffectContext
from trms_cli.effects.extended_model import extend_model
from trms_cli.gap.diagnosis import Cause, DiagnosisResult, LocationShare
from trms_cli.gap.problem import GapProblem
from trms_cli.gap.shrinkage import measure_shrinkage
from trms_cli.models.model import Model, names
from trms_cli.models.parameters import Parameter

_UNITS, _FOLDS = 60, 5
_RIDGES = (3e-3, 3e-2, 0.3, 3.0)
#: Weights of the random layer, in standard deviations of what goes in; steps in a rate, as of
#: friction, need steep ones.
_STEEPNESS = (0.5, 1.5, 6.0)
#: Inputs beyond so many standard deviations count as that.
_CLIP = 3.0
#: Share of the force that has to be foretold out of sample for an equation to get one.
_LEAST = 0.01


@dataclass(frozen=True)
class Layer:
    """Random features of a rig's motion."""

    centre: FloatArray  #: (n_s,) arrays; of the inputs
    width: FloatArray  #: (n_s,) arrays; of the inputs
    weights: FloatArray  #: (units, n_s) array
    offsets: FloatArray  #: (units,) array

    def __call__(self, s: ca.SX) -> ca.SX:
        """Features of inputs (n_s, 1): the inputs themselves, then the tanh units, then 1."""
        z = (s - ca.DM(self.centre)) / ca.DM(self.width)
        z = ca.fmin(ca.fmax(z, -_CLIP), _CLIP)
        return ca.vertcat(z, ca.tanh(ca.DM(self.weights) @ z + ca.DM(self.offsets)), 1)


@dataclass(frozen=True)
class LearntForce(Effect):
    """A regressed force on each equation, as an effect of a model."""

    layer: Layer
    #: dict of str to (n,) array; by the equation's disturbance
    coefficients: Mapping[str, FloatArray] = field(default_factory=dict)

    def __hash__(self) -> int:
        return id(self)

    def parameters(self) -> tuple[Parameter, ...]:
        return ()

    def check(self, model: Model) -> None:
        pass

    def disturbance(self, at: EffectContext) -> ca.SX:
        force = ca.SX.zeros(at.model.n_w)
        features = self.layer(inputs(at))
        for place, c in self.coefficients.items():
            row = names(at.model.disturbances).index(place)
            force[row] += ca.dot(ca.DM(c), features)
        return force


def inputs(at: EffectContext) -> ca.SX:
    """What the force may depend on: angles, rates, rotor speeds, commands."""
    model = at.model
    signals = [at.angle(axis) for axis in model.axes] + [at.rate(axis) for axis in model.axes]
    signals += [at.speed(rotor) for rotor in model.rotor_speeds]
    return ca.vertcat(*signals, at.u)


@dataclass(frozen=True, kw_only=True)
class FlexibleResidual:
    """Refit, and a learnt force; it names nothing."""

    name: ClassVar[str] = "flexible_residual"

    def answer(self, problem: GapProblem) -> DiagnosisResult:
        """See :class:`~experiments.gap.baselines.baseline.Baseline`."""
        start_time = time.perf_counter()
        parts = parts_of(problem)
        fit = refit(problem, parts)
        trajectory = motion(fit.model, parts.fitted, (), parts.block)
        force, foretold = learnt(fit.model, trajectory, problem.seed)
        model = extend_model(fit.model, {"learnt_force": force}) if foretold else fit.model
        total = sum(foretold.values())
        return diagnosis(
            problem,
            "none_of_these" if foretold else "no_gap",
            [Cause(effects=("none_of_these" if foretold else "no_gap",), probability=1.0)],
            measure_shrinkage(problem, parts, problem.model, fit.model, model),
            where=[
                LocationShare(location=place, share=share / total, ci95=(0.0, 1.0))
                for place, share in sorted(foretold.items(), key=lambda item: -item[1])
            ],
            parameters=fit.nominal(),
            refit=fit.values,
            sentence="A force was learnt; what it is, is not said.",
            description=[
                f"{place}: {100 * share:.0f} % of the smoothed force foretold out of sample"
                for place, share in foretold.items()
            ],
            seconds={"all": time.perf_counter() - start_time},
        )


def learnt(model: Model, trajectory: Motion, seed: int) -> tuple[LearntForce, dict[str, float]]:
    """A force on each equation, and the share of the smoothed one that it foretells."""
    x, u, p, w = model.symbols()
    s = inputs(EffectContext(model, x, u, p, w, ca.SX.zeros(0), {}))
    n = len(trajectory.x)
    parameters = np.repeat(model.parameters.values[:, None], n, axis=1)
    disturbances = np.zeros((model.n_w, n))
    along = ca.Function("inputs", [x, u, p, w], [ca.densify(s)]).map(n)
    input_samples = np.array(
        ca.DM(along(trajectory.x.T, trajectory.u.T, parameters, disturbances)).full()
    ).T
    layer = _layer(input_samples, seed)
    symbol = ca.SX.sym("s", input_samples.shape[1])
    features = ca.Function("features", [symbol], [ca.densify(layer(symbol))]).map(n)
    columns = np.array(ca.DM(features(input_samples.T)).full()).T
    coefficients, foretold = {}, {}
    for i, place in enumerate(names(model.disturbances)):
        c, share = _ridged(columns, trajectory.force[:, i], trajectory)
        if share > _LEAST:
            coefficients[place], foretold[place] = c, share
    return LearntForce(layer, coefficients), foretold


def _layer(input_samples: FloatArray, seed: int) -> Layer:
    random = np.random.default_rng(np.random.SeedSequence([seed, 0x1A7E]))
    n_s = input_samples.shape[1]
    weights = random.standard_normal((_UNITS, n_s)) / np.sqrt(n_s)
    weights *= np.resize(_STEEPNESS, _UNITS)[:, None]
    # Every third unit looks at one input alone: most forces of rigs do.
    for k in range(0, _UNITS, 3):
        alone = np.zeros(n_s)
        alone[k // 3 % n_s] = _STEEPNESS[-1] * random.uniform(0.2, 2.0)
        weights[k] = alone
    offsets = random.standard_normal(_UNITS) * np.where(np.arange(_UNITS) % 3, 1.0, 0.3)
    return Layer(
        input_samples.mean(axis=0), np.maximum(input_samples.std(axis=0), 1e-9), weights, offsets
    )


def _ridged(columns: FloatArray, force: FloatArray, trajectory: Motion) -> tuple[FloatArray, float]:
    """Coefficients at the best ridge, and the share that is foretold in cross-validation."""
    fold, total = trajectory.block % _FOLDS, float(np.mean(force**2))
    spread = np.maximum(np.std(columns, axis=0), 1e-9)
    spread[-1] = 1.0
    scaled = columns / spread
    worth = trajectory.independent / len(force)
    errors = np.full((len(_RIDGES), _FOLDS), np.nan)
    for f in range(_FOLDS):
        train, test = fold != f, fold == f
        if train.any() and test.any():
            for k, ridge in enumerate(_RIDGES):
                c = _solved(scaled[train], force[train], ridge / worth)
                errors[k, f] = np.mean((force[test] - scaled[test] @ c) ** 2)
    mean = np.nanmean(errors, axis=1)
    best = int(np.argmin(mean))
    share = 1 - float(mean[best]) / total if total > 0 else 0.0
    coefficients = _solved(scaled, force, _RIDGES[best] / worth) / spread
    return coefficients, share


def _solved(columns: FloatArray, force: FloatArray, ridge: float) -> FloatArray:
    inner = columns.T @ columns + ridge * np.eye(columns.shape[1])
    return np.asarray(np.linalg.solve(inner, columns.T @ force))
