"""What methods of linear models share: choice of the orders, uncertainty, result.

Sources: L. Ljung (1999), "System Identification: Theory for the User", 2nd ed.: ARX §4.2, criteria
§16.4; B. Efron & R. J. Tibshirani (1993), "An Introduction to the Bootstrap", chapter 11: the
jackknife.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from time import process_time
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError, RecordingError, TrmsError
from trms_cli.identification.linear.linear_data import LinearData, free_run_error, prepare
from trms_cli.identification.problem import (
    FitOutcome,
    FitProblem,
    FitResult,
    HistoryPoint,
    Progress,
)
from trms_cli.models.linear_file import LinearFile
from trms_cli.models.state_space import DiscreteStateSpace

Order = Annotated[int, Meta(ge=1, le=100)]
#: A number, or several of which the criterion chooses.
Orders = Order | tuple[Order, ...]
Criterion = Literal["held_out", "aic", "bic"]
#: Free runs whose errors differ by a smaller share than this are as good as each other: between
#: stretches of one recording they differ by more.
_AS_GOOD = 0.05
#: Blocks of the jackknife.
_BLOCKS = 10


@dataclass(frozen=True)
class LinearEstimate:
    """A model of chosen orders."""

    orders: Mapping[str, int]
    state_space: DiscreteStateSpace
    #: Residuals one step ahead of the fitted rows, (n, n_y), in units of the spread
    residuals: FloatArray = field(repr=False)
    parameters: int  #: Estimated numbers
    #: By output and term, ``{value, sd}`` in the signals' units; empty for a method without
    coefficients: Mapping[str, Any] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)  #: What else is recorded

    def information(self, weight: float) -> float:
        """``ln det Λ + weight · p / N``, Λ the covariance of the residuals (Ljung 1999, §16.4)."""
        n = len(self.residuals)
        sign, value = np.linalg.slogdet(self.residuals.T @ self.residuals / n)
        return float(value) + weight * self.parameters / n if sign > 0 else -np.inf


@dataclass(frozen=True, kw_only=True)
class LinearMethod(ABC):
    """A method that fits a linear model, with the keys that all of them have."""

    #: How the orders are chosen of several: the free run over what is held out, or Akaike's or the
    #: Bayesian information criterion of the residuals one step ahead
    criterion: Criterion = "held_out"
    #: By signal, the operating point in its unit; the mean of the fitted recordings where not given
    operating_point: Mapping[str, float] = field(default_factory=dict)
    sample_time: Annotated[float, Meta(gt=0)] | None = None  #: s; None: the recordings'

    name: ClassVar[str]
    fits_parameters: ClassVar[bool] = False

    @abstractmethod
    def candidates(self, data: LinearData) -> list[dict[str, int]]:
        """Orders to choose from, by the names that are told.

        Raises ConfigurationError for orders that no model of these signals has.
        """

    @abstractmethod
    def estimate(
        self, data: LinearData, orders: Mapping[str, int], first: int | None = None
    ) -> LinearEstimate:
        """The model of given orders.

        ``first``: of each stretch, samples that are only looked back to; None: as few as the orders
        need. Raises RecordingError if there are too few samples.
        """

    @abstractmethod
    def look_back(self, orders: Mapping[str, int]) -> int:
        """Samples before the first that is predicted."""

    def fit(self, problem: FitProblem, progress: Progress) -> FitResult:
        """Fit the problem; see :class:`trms_cli.identification.problem.Method`."""
        begin = process_time()
        data = prepare(problem, self.sample_time, self.operating_point)
        candidates = self.candidates(data)
        if self.criterion == "held_out" and not data.validation and len(candidates) > 1:
            raise ConfigurationError(
                "nothing is held out to choose the orders by",
                where="method.criterion",
                remedy="hold something out (validation.share=0.25), choose by "
                "method.criterion=bic, or give one number for each order",
            )
        first = max(self.look_back(orders) for orders in candidates)
        stable: list[tuple[float, LinearEstimate]] = []
        history, table, outcome = [], [], FitOutcome.CONVERGED
        for number, orders in enumerate(candidates, start=1):
            estimate = self.estimate(data, orders, first if len(candidates) > 1 else None)
            score = self._score(data, estimate)
            radius = estimate.state_space.spectral_radius
            table.append({**orders, "criterion": _finite(score), "largest_pole": radius})
            if radius < 1.0 and np.isfinite(score):
                stable.append((score, estimate))
            lowest = min((score for score, _ in stable), default=np.inf)
            history.append(HistoryPoint(number, process_time() - begin, lowest))
            told = ", ".join(f"{key} {value}" for key, value in orders.items())
            if not progress.update(number / len(candidates), history[-1].cost, told):
                outcome = FitOutcome.INTERRUPTED
                break
        if not stable:
            raise self._unstable(data, table)
        cost, chosen = self._choice(stable)
        record = self._record(data, chosen, table)
        model = problem.model
        bounds = dict(zip(data.inputs, model.input_bounds()[1].tolist(), strict=True))
        stops = {name: float(stop) for name, stop in model.stops.items()}
        limits = {name: value for name, value in (bounds | stops).items() if np.isfinite(value)}
        document = LinearFile(
            name=self.name, state_space=chosen.state_space, limits=limits, training=record
        )
        return FitResult(
            method=self.name,
            outcome=outcome,
            cost=cost,
            history=history,
            evaluations=len(history),
            seconds=process_time() - begin,
            model_document=document.to_data(),
            details=record,
        )

    def _score(self, data: LinearData, estimate: LinearEstimate) -> float:
        if self.criterion == "held_out":
            parts = data.validation or data.fitted
            return free_run_error(data, estimate.state_space, parts)
        weight = 2.0 if self.criterion == "aic" else float(np.log(len(estimate.residuals)))
        return estimate.information(weight)

    def _choice(
        self, candidates: Sequence[tuple[float, LinearEstimate]]
    ) -> tuple[float, LinearEstimate]:
        """The best by the criterion; of free runs that are as good, that of fewest coefficients."""
        best = min(score for score, _ in candidates)
        reach = best * (1.0 + _AS_GOOD) if self.criterion == "held_out" else best
        near = [candidate for candidate in candidates if candidate[0] <= reach]
        return min(near, key=lambda candidate: (candidate[1].parameters, candidate[0]))

    def _record(
        self,
        data: LinearData,
        chosen: LinearEstimate,
        table: Sequence[Mapping[str, Any]],
    ) -> dict[str, Any]:
        space = chosen.state_space
        parts = self._without_each_block(data, chosen)
        gains = space.static_gain()
        spread = jackknife_sd([part.static_gain() for part in parts], gains.shape)
        record: dict[str, Any] = {
            "method": self.name,
            "orders": dict(chosen.orders),
            "parameters": chosen.parameters,
            "rows": len(chosen.residuals),
            "residual_sd": dict(
                zip(
                    data.outputs,
                    (chosen.residuals.std(axis=0) * data.output_sd).tolist(),
                    strict=True,
                )
            ),
            "largest_pole": space.spectral_radius,
            "slowest_time_constant_s": float(-space.sample_time / np.log(space.spectral_radius)),
            "static_gain": {
                f"{y} by {u}": {"value": _finite(gains[i, j]), "sd": _finite(spread[i, j])}
                for i, y in enumerate(data.outputs)
                for j, u in enumerate(data.inputs)
            },
            "free_run": {
                part: _finite(free_run_error(data, space, recordings)) if recordings else None
                for part, recordings in (("fitted", data.fitted), ("validation", data.validation))
            },
        }
        if chosen.coefficients:
            record["coefficients"] = dict(chosen.coefficients)
        record |= {**chosen.details, **self.uncertainty(data, space, parts)}
        if len(table) > 1:
            record["candidates"] = [dict(row) for row in table]
        return record

    def uncertainty(
        self, data: LinearData, space: DiscreteStateSpace, parts: Sequence[DiscreteStateSpace]
    ) -> dict[str, Any]:
        """What the models without a tenth of the samples each tell besides the static gains."""
        return {}

    def _without_each_block(
        self, data: LinearData, chosen: LinearEstimate
    ) -> list[DiscreteStateSpace]:
        """Models of the same orders with a tenth of the samples left out, for the jackknife.

        What the formulas of least squares take for white noise, the rig's nonlinearity makes most
        of, and it differs from stretch to stretch: as these models do.
        """
        models = []
        for block in range(_BLOCKS):
            try:
                part = self.estimate(data.without_block(block, _BLOCKS), chosen.orders)
            except TrmsError:
                continue
            models.append(part.state_space)
        return models

    def _unstable(self, data: LinearData, table: Sequence[Mapping[str, Any]]) -> RecordingError:
        radius = min(row["largest_pole"] for row in table)
        return RecordingError(
            f"no stable {self.name} model fits: the largest pole is {radius:.4f}, and its free run "
            "would grow without bound",
            where=data.source,
            remedy="choose other orders, a longer method.sample_time, or method=subspace, which "
            "keeps poles inside the unit circle; or record longer",
        )


def least_squares(columns: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Coefficients (p,) of least squares for a target (n,), and their covariance (p, p)."""
    theta = np.asarray(np.linalg.lstsq(columns, target, rcond=None)[0], dtype=np.float64)
    residual = target - columns @ theta
    return theta, noise_covariance(columns, residual)


def noise_covariance(slopes: FloatArray, residual: FloatArray) -> FloatArray:
    """``σ² (JᵀJ)⁻¹`` of residuals (n,) with the slopes J (n, p) in the coefficients."""
    n, p = slopes.shape
    variance = float(residual @ residual) / max(1, n - p)
    return np.asarray(variance * np.linalg.pinv(slopes.T @ slopes, hermitian=True))


def jackknife_sd(values: Sequence[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    """Standard deviation of an estimate from those with a part of the data left out each.

    ``shape``: of an estimate. NaN where too few of them could be made.
    """
    n = len(values)
    if n <= _BLOCKS / 2:
        return np.full(shape, np.nan)
    return np.asarray(np.sqrt((n - 1) * np.var(np.stack(values), axis=0)))


def choices(value: Orders, where: str) -> tuple[int, ...]:
    """The numbers that an order may be, rising.

    Raises ConfigurationError if there is none.
    """
    numbers = (value,) if isinstance(value, int) else tuple(sorted(set(value)))
    if not numbers:
        raise ConfigurationError("no order is given", where=where, remedy="for instance [2,4,6]")
    return numbers


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
