"""The flexible competitor: a residual without a name, fitted by simulation like every named cause.

A named cause has to foretell held-out blocks as well as a sum of smooth terms that knows no physics
(:mod:`trms_cli.effects.residual`). Where none does, something is missing that has no name here; and
what not even the sum foretells comes from outside.

The sum acts on the equation in which the gap lies by :func:`~trms_cli.gap.residuals.locate`, and
on the sensor of that axis where that explains more. Its coefficients have normal priors as wide as
the smoothed missing force is large. A ridge regression on that force says where the search begins,
with a trend in time beside the terms, which is dropped again: it foretells nothing. Then the common
search refines the coefficients through simulation. A force from outside does not survive that: the
motion that it caused predicts it, and explains nothing of it.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.errors import TrmsError
from trms_cli.effects.effect import EffectContext
from trms_cli.effects.residual import (
    Residual,
    ResidualForce,
    ResidualReading,
    Spans,
    symbolic,
    term_names,
    terms,
    usual_spans,
    variables,
)
from trms_cli.gap.competing_model import FittedModel, Metric, ModelStructure, Refit
from trms_cli.gap.discrepancy import likely_shares
from trms_cli.gap.force.exogenous import held_out_errors
from trms_cli.gap.force.laws import ForceRecord
from trms_cli.gap.force.short_law import short_law_of
from trms_cli.gap.problem import CandidateEffect
from trms_cli.gap.residuals import Location
from trms_cli.identification.problem import FreeParameter
from trms_cli.models.model import Model, Signal
from trms_cli.models.parameters import Parameter
from trms_cli.models.rig_parts import RigParts, parts_of
from trms_cli.models.scales import BENCH, port_scale

#: Nats that disturbances together must gain: with less there is no gap to be flexible about.
_LEAST_GAP = 10.0
#: A force that foretells less of what is missing lets another place be tried too, where a
#: disturbance closes so much of the gap.
_ENOUGH, _WORTH = 0.95, 0.2
#: Share below which it foretells nothing.
_NOTHING = 0.3
#: Hz. A smoothed force has no more; and ridge penalties of the regression.
_RATE = 6.0
_PENALTIES = (1e-3, 1e-2, 1e-1)
#: Powers of time beside the terms.
_TRENDS = 3
#: Steps of the search before and after the discrepancy is estimated, and its tolerance, nats.
_STEPS, _LAST_STEPS, _TOLERANCE = 4, 3, 1.0
#: How often the widths of the priors are estimated, in how many rounds, and their range in the
#: first width.
_TURNS, _ROUNDS, _NARROWEST, _WIDEST = 2, 20, 0.02, 3.0
#: What the names of terms that share a width differ in.
_GROUPED = re.compile(r"_bump_\d+$|(?:co)?sine_(?=\d+$)")
#: A coefficient of a sensor's error has a prior so wide: rad, or the same share of a travel.
_READING = 0.02


@dataclass(frozen=True, kw_only=True)
class _Free(Residual):
    """A residual with its coefficients as sizes, so that they can be fitted.

    The spans are sizes too, which no fit moves: recordings share the compiled code.
    """

    names: tuple[str, ...]
    unit: str

    def parameters(self) -> tuple[Parameter, ...]:
        spans = []
        for name, middle, half in self.spans:
            spans += [Parameter(f"{name}_middle", middle), Parameter(f"{name}_half", half)]
        return (*(Parameter(name, 0.0, self.unit) for name in self.names), *spans)

    def coefficients(self, at: EffectContext) -> dict[str, ca.SX]:
        return {name: at.sizes[name] for name in self.names}

    def ranges(self, at: EffectContext) -> Spans:
        return {n: (at.sizes[f"{n}_middle"], at.sizes[f"{n}_half"]) for n, *_ in self.spans}


@dataclass(frozen=True, kw_only=True)
class _FreeForce(_Free, ResidualForce):
    pass


@dataclass(frozen=True, kw_only=True)
class _FreeReading(_Free, ResidualReading):
    pass


@dataclass(frozen=True)
class Flexible:
    """The competitor as it was fitted."""

    fitted: FittedModel  #: In the discrepancy that is most likely for itself
    location: str  #: Equation whose missing force it was begun with
    #: Share of that force, squared, that it foretells on blocks that it was not fitted to, 0 to 1
    foretold: float

    @property
    def score(self) -> float:
        """Summed log predictive density of the blocks, nats."""
        return self.fitted.fit.score

    @property
    def places(self) -> tuple[str, ...]:
        """Where in the block diagram it acts."""
        return tuple(at for c in self.fitted.structure.effects for at in c.locations)

    @cached_property
    def effects(self) -> dict[str, Residual]:
        """The fitted residuals as effects of a model, by name."""
        values, effects = self.fitted.values_at_mean_gains, dict[str, Residual]()
        for name, free in ((c.name, c.effect) for c in self.fitted.structure.effects):
            assert isinstance(free, (_FreeForce, _FreeReading))
            fixed = tuple((n, values[f"{name}.{n}"]) for n in free.names)
            if isinstance(free, _FreeForce):
                effects[name] = ResidualForce(equation=free.equation, terms=fixed, spans=free.spans)
            else:
                effects[name] = ResidualReading(axis=free.axis, terms=fixed, spans=free.spans)
        return effects


def node_of(effect: Residual) -> dict[str, Any]:
    """A residual as an option says it: its class and its arguments."""
    place = "equation" if isinstance(effect, ResidualForce) else "axis"
    return {
        "_target_": f"{type(effect).__module__}.{type(effect).__name__}",
        place: getattr(effect, place),
        "terms": [list(term) for term in effect.terms],
        "spans": [list(span) for span in effect.spans],
        "share": effect.share,
    }


def name_of(place: str, parts: RigParts) -> str:
    """Name of the option that puts a residual at a place."""
    kind = "reading" if parts.kind_of(place) == "sensor" else "force"
    return f"{parts.part_of(place)}_residual_{kind}"


def fit_flexible(
    refit: Refit, place: Location, forces: Mapping[str, ForceRecord]
) -> Flexible | None:
    """Fit the competitor where the gap lies; None where there is none, or no equation has a name.

    ``place``: what disturbances close of the gap. ``forces``: smoothed missing force of each
    equation.
    """
    shares = place.share()
    parts = parts_of(refit.structure.problem.model)
    equations = [k for k in shares if k in forces and parts.kind_of(k) in ("moment", "motor")]
    ranking = sorted(equations, key=lambda k: -shares[k])
    if not ranking or place.together.sum() < _LEAST_GAP:
        return None
    motion = _Motion(refit)
    first = ranking[0]
    try:
        best = _fit_residual(motion, first, forces)
        if best.foretold < _ENOUGH:
            for other in _others(parts, first, ranking[1:], shares):
                alternative = _fit_residual(motion, first, forces, other, best)
                best = max(best, alternative, key=lambda flexible: flexible.score)
    except (TrmsError, FloatingPointError, np.linalg.LinAlgError):
        return None  # what cannot be simulated is no competitor
    return best if np.isfinite(best.score) else None


def _others(
    parts: RigParts, first: str, equations: list[str], shares: Mapping[str, float]
) -> list[str]:
    """Where a residual might explain what a force on the first equation leaves."""
    sensor = [f"{parts.part_of(first)}_sensor"] if parts.kind_of(first) == "moment" else []
    return [at for at in (*sensor, *equations[:1]) if shares.get(at, 0.0) > _WORTH][:1]


def _fit_residual(
    motion: _Motion,
    location: str,
    forces: Mapping[str, ForceRecord],
    other: str = "",
    before: Flexible | None = None,
) -> Flexible:
    """Fit a residual on an equation; with ``other`` on a sensor instead, or on another equation.

    That has a residual of its own beside the first one's, or alone where that foretells nothing.
    ``before``: the fit to the first equation alone.
    """
    refit = motion.refit
    if other in forces and before is not None and before.foretold < _NOTHING:
        location, other, before = other, "", None
    values, shares = dict(refit.values), refit.metric.shares.copy()
    if other.endswith("sensor"):
        candidates = [motion.candidate(other, motion.reading_size(other))]
    else:
        places = [location, *([other] if other else [])]
        sizes = [float(np.sqrt(np.mean(forces[place].force ** 2))) for place in places]
        candidates = list(map(motion.candidate, places, sizes))
        for place in places:
            coefficients, predicted_share = motion.regress(place, forces[place])
            values |= coefficients
            at = [c.location for c in refit.metric.discrepancy.channels].index(place)
            shares[at] *= np.sqrt(np.clip(1 - predicted_share, 0.05, 1.0))
        if before is not None:
            values |= before.fitted.values
    structure = refit.structure.with_effects(*candidates)
    metric = replace(refit.metric, shares=shares)
    fitted = structure.fit(
        metric,
        [structure.point(values, refit.fit.starts)],
        centres=refit.centres,
        gains=refit.fit.gains,
        iterations=_STEPS,
        tolerance=_TOLERANCE,
        with_evidence=False,
    )
    shares = likely_shares(metric.discrepancy, fitted.residuals, metric.shares)
    metric = replace(metric, shares=shares)
    for turn in range(_TURNS):
        sd, theta = _relevant(fitted, metric)
        fitted = _with_priors(structure, sd).fit(
            metric,
            [(theta, fitted.fit.starts)],
            centres=refit.centres,
            gains=fitted.fit.gains,
            iterations=_LAST_STEPS,
            tolerance=_TOLERANCE,
            with_evidence=turn + 1 == _TURNS,
        )
    return Flexible(fitted, location, foretold_share(refit, fitted, location))


def _relevant(fitted: FittedModel, metric: Metric) -> tuple[dict[str, float], FloatArray]:
    """Standard deviation of the prior of each coefficient by name, and the parameters with them.

    Those that make the recordings most likely, for the cost's parabola (MacKay 1992, Neural
    Computation 4): a term that nothing speaks for is held near zero, the sine and cosine of a
    harmonic alike, the bumps over a range alike.
    """
    fit, objective = fitted.fit, replace(fitted, metric=metric).objective
    parabola = _parabola(fitted, metric)
    curvature, pull = parabola.curvature, parabola.pull
    names = [p.name for p in fitted.structure.problem.free]
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        if name.split(".")[0] in fitted.names:
            groups.setdefault(_GROUPED.sub("", name), []).append(i)
    precision = np.asarray(parabola.prior_root**2, dtype=np.float64)
    centre = (objective.means - fit.point) / objective.scales
    for _ in range(_ROUNDS):
        covariance = np.linalg.inv(curvature + np.diag(precision))
        move = np.asarray(covariance @ (precision * centre - pull))
        for rows in groups.values():
            size = move[rows] - centre[rows]  # of the coefficients themselves
            effective_number = np.sum(1 - precision[rows] * np.diag(covariance)[rows])
            new_precision = max(float(effective_number), 1e-3) / max(float(size @ size), 1e-12)
            precision[rows] = np.clip(new_precision, 1 / _WIDEST**2, 1 / _NARROWEST**2)
    move = np.asarray(np.linalg.solve(curvature + np.diag(precision), precision * centre - pull))
    scales = objective.scales
    sd = {names[i]: scales[i] / np.sqrt(precision[i]) for r in groups.values() for i in r}
    return sd, fit.theta + (move * scales)[: len(names)]


def _with_priors(structure: ModelStructure, sd: Mapping[str, float]) -> ModelStructure:
    """The same with other widths of some priors."""
    free = tuple(
        replace(p, prior_sd=sd[p.name]) if p.name in sd else p for p in structure.problem.free
    )
    variant = copy.copy(structure)
    variant.problem = replace(structure.problem, free=free)
    variant.windows = copy.copy(structure.windows)
    variant.windows.problem = variant.problem
    return variant


@dataclass(frozen=True)
class _Motion:
    """The motion that the data show, along which terms are evaluated."""

    refit: Refit

    @property
    def model(self) -> Model:
        return self.refit.structure.problem.model

    @property
    def block(self) -> IntArray:
        """Block of each sample, (k,)."""
        inside = self.refit.structure.windows.inside
        return np.broadcast_to(np.arange(len(inside))[:, None], inside.shape)[inside]

    def along(self, build: Callable[[EffectContext], Mapping[str, ca.SX]]) -> dict[str, FloatArray]:
        """Expressions by name, (k,) each."""
        model, windows = self.model, self.refit.structure.windows
        x, u, p, w = model.symbols()
        expressions = build(EffectContext(model, x, u, p, w, ca.SX.zeros(0), {}))
        inside = windows.inside
        states = self.refit.metric.discrepancy.trajectory.x[..., : model.n_x][inside]
        n = len(states)
        along = ca.Function("along", [x, u, p, w], [ca.densify(ca.vertcat(*expressions.values()))])
        parameters = np.repeat(self.refit.model.parameters.values[:, None], n, axis=1)
        no_force = np.zeros((model.n_w, n))
        rows = along.map(n)(states.T, windows.commands[inside].T, parameters, no_force)
        return dict(zip(expressions, np.array(ca.DM(rows).full()), strict=True))

    @cached_property
    def spans(self) -> tuple[tuple[str, float, float], ...]:
        """Middle and half of the range of each variable."""
        ranges, usual = [], usual_spans(self.model)
        for name, values in self.along(variables).items():
            low, high = np.quantile(values, (0.005, 0.995))
            half = max(float(high - low) / 2, 0.02 * usual[name][1])
            ranges.append((name, float(high + low) / 2, half))
        return tuple(ranges)

    def terms(self, place: str) -> dict[str, FloatArray]:
        """The terms at a place by name, (k,) each."""
        spans = symbolic({name: (m, h) for name, m, h in self.spans})
        return self.along(lambda at: dict(terms(at, place, spans)))

    def reading_size(self, place: str) -> float:
        """How wide the prior of a coefficient of a sensor's error is, in the sensor's unit."""
        axis = parts_of(self.model).part_of(place)
        return _READING * port_scale(self.model, axis=axis).travel / BENCH.travel

    def candidate(self, place: str, size: float) -> CandidateEffect:
        """A residual with its coefficients free; ``size``: sd of the prior of each."""
        parts = parts_of(self.model)
        name, names = name_of(place, parts), term_names(self.model, place)
        signals: dict[str, Signal] = {s.name: s for s in self.model.disturbances}
        effect: _FreeForce | _FreeReading
        if place in signals:
            effect = _FreeForce(
                equation=place, names=names, unit=signals[place].unit, spans=self.spans
            )
        else:
            axis = parts.part_of(place)
            effect = _FreeReading(axis=axis, names=names, unit=parts.unit(axis), spans=self.spans)
        free = tuple(
            FreeParameter(
                name=f"{name}.{term}",
                unit=effect.unit,
                start=0.0,
                prior_mean=0.0,
                prior_sd=size,
                lower=-np.inf,
                upper=np.inf,
            )
            for term in names
        )
        return CandidateEffect(name, effect, (place,), free, np.zeros((0, len(names))), False)

    def regress(self, location: str, record: ForceRecord) -> tuple[dict[str, float], float]:
        """Coefficients that fit the smoothed force, by name.

        With them the share of it that they foretell on held-out blocks. A trend in time stands
        beside them.
        """
        columns = self.terms(location)
        stride = max(1, round(1.0 / (_RATE * record.sample_time)))
        phi = np.array(list(columns.values())).T[::stride]
        force, block = record.force[::stride], self.block[::stride]
        trends = _trends(record)[::stride]
        energy = max(float(force @ force), 1e-300)
        errors = [
            float(held_out_errors(phi, force[:, None], block, penalties=(p,)).sum())
            for p in _PENALTIES
        ]
        penalty = _PENALTIES[int(np.argmin(errors))]
        both = np.hstack([phi, trends])
        gram = both.T @ both + penalty * len(force) * np.eye(both.shape[1])
        weights = np.linalg.solve(gram, both.T @ force)
        own = weights[: phi.shape[1]]
        name = name_of(location, parts_of(self.model))
        coefficients = {f"{name}.{term}": float(w) for term, w in zip(columns, own, strict=True)}
        return coefficients, 1 - min(errors) / energy


def _trends(record: ForceRecord) -> FloatArray:
    """Powers of time in each recording, (k, recordings × powers), within ±1."""
    columns = []
    for number in np.unique(record.recording):
        here = record.recording == number
        time = record.time[here]
        scaled_time = 2 * (time - time[0]) / max(float(np.ptp(time)), 1e-9) - 1
        for power in range(1, _TRENDS + 1):
            column = np.zeros(len(here))
            column[here] = scaled_time**power
            columns.append(column)
    return np.array(columns).T


def foretold_share(refit: Refit, fitted: FittedModel, location: str) -> float:
    """Share of an equation's missing force, squared, that a fit foretells on held-out blocks.

    A block that is foretold worse than by nothing counts as not foretold: what was seen nowhere
    else is extrapolated, at times far out.
    """
    discrepancy, shares = refit.metric.discrepancy, refit.metric.shares
    at = discrepancy.trajectory.x.shape[-1]
    at += [channel.location for channel in discrepancy.channels].index(location)
    inside = refit.structure.windows.inside
    before, after = (
        np.sum(discrepancy.smoothed(shares, r)[0][..., at] ** 2, axis=1, where=inside)
        for r in (refit.residuals, held_out_residuals(fitted))
    )
    after = np.where(np.isfinite(after), np.minimum(after, before), before)
    return 1 - float(after.sum()) / max(float(before.sum()), 1e-300)


@dataclass(frozen=True)
class _Parabola:
    """The cost about a fit as a parabola in scaled changes, its starts eliminated."""

    whole: FloatArray  #: (m, k, n + n_f + 1) array; triangles of each window with its start's prior
    n: int  #: Number of states that a window begins with
    prior_root: FloatArray  #: (n_f,) array; root of the precision of each parameter's prior
    slopes: FloatArray  #: (m, c, n_y, n + n_f) array; of predicted less measured, scaled
    residuals: FloatArray  #: (m, c, n_y) array; predicted less measured

    @property
    def rows(self) -> tuple[FloatArray, FloatArray]:
        """Slopes (m, k, n_f) and residuals (m, k) of each window."""
        return self.whole[:, self.n :, self.n : -1], self.whole[:, self.n :, -1]

    @property
    def curvature(self) -> FloatArray:
        """Of the data in the parameters, (n_f, n_f)."""
        r = self.rows[0].reshape(-1, self.whole.shape[-1] - self.n - 1)
        return np.asarray(r.T @ r)

    @property
    def pull(self) -> FloatArray:
        """Slope of the data's part of the cost, (n_f,)."""
        r, c = self.rows
        return np.asarray(np.einsum("mkf,mk->f", r, c))


def _parabola(fitted: FittedModel, metric: Metric) -> _Parabola:
    structure, fit = fitted.structure, fitted.fit
    objective = replace(fitted, metric=metric).objective
    _, quadratic, residuals = objective.parabola(fit.point, fit.starts)
    whole = np.asarray(np.linalg.qr(quadratic.rows, mode="r"))
    if not np.isfinite(whole).all():
        raise FloatingPointError("the slopes of a simulation run away")
    slopes = objective.slopes(residuals) * np.concatenate(
        [structure.windows.spread, objective.scales]
    )
    return _Parabola(whole, quadratic.n, quadratic.prior_root, slopes, residuals.r)


def held_out_residuals(fitted: FittedModel) -> FloatArray:
    """Measured less predicted of each block by a fit to all others, (m, c, n_y).

    Exact for the cost's parabola, as the evidence is.
    """
    parabola = _parabola(fitted, fitted.metric)
    (r, c), n, whole = parabola.rows, parabola.n, parabola.whole
    total = parabola.curvature + np.diag(parabola.prior_root**2)
    residuals = -parabola.residuals
    for j in range(len(residuals)):
        shift = np.linalg.solve(total - r[j].T @ r[j], r[j].T @ c[j])
        right_side = whole[j, :n, n:-1] @ shift + whole[j, :n, -1]
        back = -np.linalg.solve(whole[j, :n, :n], right_side)
        residuals[j] -= parabola.slopes[j] @ np.concatenate([back, shift])
    return residuals


def short_law(
    refit: Refit, flexible: Flexible, forces: Mapping[str, ForceRecord]
) -> tuple[str, ...]:
    """The shortest formula near what a residual does, in a sentence; empty where none is near."""
    record = forces[flexible.location]
    for effect in flexible.effects.values():
        if isinstance(effect, ResidualReading):
            columns = _Motion(refit).terms(effect.place)
            error = np.sum([size * columns[name] for name, size in effect.terms], axis=0)
            record = replace(
                record,
                location=effect.place,
                unit=record.parts.unit(effect.axis),
                force=error - error.mean(),
                sd=0 * error,
            )
    return short_law_of(record)
