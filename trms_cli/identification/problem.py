"""What is to be fitted, and what a method of identification makes of it.

A problem is a model, its free parameters with what is known of them, and recordings; a method
gives back the fitted model, and can be stopped on the way.
"""

import copy
import fnmatch
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest, require_known
from trms_cli.identification.dataset import Dataset
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model, names
from trms_cli.models.parameters import Parameter, ParameterSet

#: The word of ``free`` for all parameters that have a prior.
PRIORS = "priors"
#: Share of its start by which a parameter without prior is scaled; of 1 where it starts at 0.
_SCALE_WITHOUT_PRIOR = 0.3
#: Share of a parameter's scale within which it counts as lying on its bound.
_ON_BOUND = 1e-3
#: s; which parameters act does not depend on it.
_ANY_STEP = 0.01


@dataclass(frozen=True, kw_only=True)
class Prior:
    """What a user says of a parameter before the data: instead of what its set says."""

    mean: float | None = None  #: In the parameter's unit; None: the value in the parameter set
    sd: Annotated[float, Meta(gt=0)] | None = None  #: Standard deviation in the parameter's unit
    #: The same as a share of the mean; with neither of the two the parameter is free of a prior
    relative_sd: Annotated[float, Meta(gt=0)] | None = None


@dataclass(frozen=True, kw_only=True)
class FreeParameter:
    """One parameter that a fit may move."""

    name: str
    unit: str
    start: float  #: The model's present value, where a search begins
    prior_mean: float  #: Centre of the normal prior; also the reference of a parameter without one
    prior_sd: float | None  #: Standard deviation, in ``unit``; None: only the bounds are known
    lower: float  #: Hard bounds, infinite where there are none
    upper: float  #: Hard bounds, infinite where there are none

    @property
    def scale(self) -> float:
        """A typical change, in ``unit``, positive: what steps and search spaces are scaled by."""
        if self.prior_sd is not None:
            return self.prior_sd
        size = max(abs(self.prior_mean), abs(self.start))
        if size > 0:
            return _SCALE_WITHOUT_PRIOR * size
        width = self.upper - self.lower
        return _SCALE_WITHOUT_PRIOR * (width if np.isfinite(width) else 1.0)

    def search_range(self, sd: float = 3.0) -> tuple[float, float]:
        """Finite bounds for a search of the whole space: ``prior_mean ± sd·scale``, within bounds.

        The start always lies inside.
        """
        low = max(self.lower, min(self.prior_mean - sd * self.scale, self.start))
        high = min(self.upper, max(self.prior_mean + sd * self.scale, self.start))
        return low, high


def free_parameters(
    parameters: ParameterSet,
    selection: Sequence[str],
    *,
    centres: ParameterSet | None = None,
    priors: Mapping[str, Prior | None] | None = None,
    bounds: Mapping[str, tuple[float | None, float | None]] | None = None,
) -> tuple[FreeParameter, ...]:
    """Free parameters by name, in the order of the model's ``parameters``.

    ``selection``: names (``k_fvp``, an effect's size ``yaw_coulomb_friction.torque``), patterns
    (``k_*``), ``priors`` for all that have a prior, and any of these after ``!`` to leave out
    again. ``centres``: where the priors lie when the model's values are other starts; None:
    ``parameters``. ``priors``: in place of the set's; None takes a parameter's prior away.
    ``bounds``: lower and upper, in place of the set's; None on a side: no bound there. Raises
    ConfigurationError for a name or pattern that fits nothing, or contradicting priors and bounds.
    """
    priors, bounds = priors or {}, bounds or {}
    free_names = set[str]()
    for word in selection:
        if word.startswith("!"):
            free_names -= _fitting(parameters, word[1:], priors)
        else:
            free_names |= _fitting(parameters, word, priors)
    if not free_names:
        raise ConfigurationError(
            "no parameter is free",
            where="free",
            remedy=(
                f"free=[{PRIORS}] frees all that have a prior; or name some of: "
                if any(p.prior_sd is not None for p in parameters)
                else "the set has no priors, so name what to fit, free=[NAME,…]: "
            )
            + ", ".join(parameters.names),
        )
    for key, entries in (("priors", priors), ("bounds", bounds)):
        for name in entries:
            require_known(name, free_names, f"{name!r} is not free", f"{key}.{name}")
    return tuple(
        _free(parameter, (centres or parameters)[parameter.name].value, priors, bounds)
        for parameter in parameters
        if parameter.name in free_names
    )


def _fitting(parameters: ParameterSet, word: str, priors: Mapping[str, Prior | None]) -> set[str]:
    if word == PRIORS:
        prior_names = {p.name for p in parameters if p.prior_sd is not None}
        return prior_names | {n for n in priors if n in parameters}
    matches = {name for name in parameters.names if fnmatch.fnmatchcase(name, word)}
    if not matches:
        raise ConfigurationError(
            f"no parameter is called {word!r}", where="free", remedy=nearest(word, parameters.names)
        )
    return matches


def _free(
    parameter: Parameter,
    centre: float,
    priors: Mapping[str, Prior | None],
    bounds: Mapping[str, tuple[float | None, float | None]],
) -> FreeParameter:
    name = parameter.name
    sd = None if parameter.prior_sd is None else abs(centre) * parameter.prior_sd
    if sd == 0.0:  # a share of zero says nothing
        sd = None
    if name in priors:
        own = priors[name]
        if own is None:
            sd = None
        else:
            if own.sd is not None and own.relative_sd is not None:
                raise ConfigurationError(
                    "sd and relative_sd are both given",
                    where=f"priors.{name}",
                    remedy="give one of them",
                )
            centre = centre if own.mean is None else own.mean
            sd = own.sd
            if own.relative_sd is not None:
                sd = abs(centre) * own.relative_sd
                if sd == 0.0:
                    raise ConfigurationError(
                        "relative_sd of a mean of zero",
                        where=f"priors.{name}",
                        remedy=f"give sd in {parameter.unit or '1'}",
                    )
    low, high = bounds.get(name, (parameter.lower, parameter.upper))
    lower = -np.inf if low is None else float(low)
    upper = np.inf if high is None else float(high)
    if not lower < upper:
        raise ConfigurationError(
            f"from {lower:g} to {upper:g}",
            where=f"bounds.{name}",
            remedy="give [lower, upper] with lower < upper, null for none",
        )
    if not lower <= centre <= upper:
        raise ConfigurationError(
            f"the prior's centre {centre:g} lies outside {lower:g} to {upper:g}",
            where=f"bounds.{name}" if name in bounds else f"priors.{name}",
            remedy=f"widen bounds.{name}, or move priors.{name}.mean",
        )
    start = float(np.clip(parameter.value, lower, upper))
    return FreeParameter(
        name=name,
        unit=parameter.unit,
        start=start,
        prior_mean=float(centre),
        prior_sd=sd,
        lower=lower,
        upper=upper,
    )


@dataclass(frozen=True, kw_only=True)
class FitProblem:
    """A model, recordings of one rig, and what may move."""

    model: Model  #: Its inputs are those of the datasets, which measure some or all of its outputs
    datasets: tuple[Dataset, ...]  #: To be fitted
    validation: tuple[Dataset, ...] = ()  #: Never fitted: for stopping early, for selection
    free: tuple[FreeParameter, ...] = ()  #: May be empty for methods that have none (networks)
    #: s: the recordings are simulated in windows of this length, each from its own start
    window_length: Annotated[float, Meta(gt=0)] = 10.0
    #: s between the starts of windows; None: they lie end to end. Overlapping windows count each
    #: sample once all the same: their weights are reduced.
    window_stride: Annotated[float, Meta(gt=0)] | None = None
    #: Residuals beyond this many standard deviations count linearly (Huber); None: never
    robust: Annotated[float, Meta(gt=0)] | None = 3.0
    #: Whether the standard deviation of each output is raised by what the model cannot follow,
    #: estimated from the residuals, above the declared noise
    discrepancy: Literal["estimate", "none"] = "estimate"
    #: Integration steps a sample; None: as many as keep a step at 20 ms or below
    substeps: Annotated[int, Meta(ge=1)] | None = None
    seed: Annotated[int, Meta(ge=0)] = 0  #: Of all that is drawn
    jobs: Annotated[int, Meta(ge=1)] = 2  #: Threads

    def __post_init__(self) -> None:
        if not self.datasets:
            raise ConfigurationError(
                "no recording is given", where="real", remedy="real=FILE, or 'real=[FILE, FILE]'"
            )
        for dataset in (*self.datasets, *self.validation):
            if names(dataset.inputs) != names(self.model.inputs):
                raise ConfigurationError(
                    f"{dataset.source} gives the inputs {', '.join(names(dataset.inputs))}, the "
                    f"model takes {', '.join(names(self.model.inputs))}",
                    where="real",
                    remedy="load it for this model (driven=… on both or on neither)",
                )
            unknown = set(names(dataset.outputs)) - set(names(self.model.outputs))
            if unknown:
                raise ConfigurationError(
                    f"the model does not predict {', '.join(sorted(unknown))} of {dataset.source}",
                    where="real",
                    remedy=f"it predicts {', '.join(names(self.model.outputs))}",
                )
        for name in self.names:
            parameter_names = self.model.parameters.names
            require_known(name, parameter_names, f"the model has no parameter {name!r}", "free")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, in order."""
        return tuple(parameter.name for parameter in self.free)

    @property
    def starts(self) -> FloatArray:
        """Their present values, shape (n_f,)."""
        return np.array([parameter.start for parameter in self.free])

    @property
    def prior_means(self) -> FloatArray:
        """Centres of their priors, shape (n_f,)."""
        return np.array([parameter.prior_mean for parameter in self.free])

    @property
    def prior_precisions(self) -> FloatArray:
        """``1/sd²`` of their priors, 0 where there is none, shape (n_f,)."""
        return np.array([0.0 if p.prior_sd is None else p.prior_sd**-2 for p in self.free])

    @property
    def scales(self) -> FloatArray:
        """Their typical changes, shape (n_f,)."""
        return np.array([parameter.scale for parameter in self.free])

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds, each (n_f,)."""
        return (
            np.array([parameter.lower for parameter in self.free]),
            np.array([parameter.upper for parameter in self.free]),
        )

    def on_bounds(self, theta: FloatArray) -> IntArray:
        """Which parameters count as lying on a bound, shape (n_f,): −1 lower, 1 upper, 0 neither.

        A search that knows no slopes comes near a bound without touching it: a thousandth of a
        parameter's scale, which no data tell from nothing, counts as being there.

        ``theta``: (n_f,) array.
        """
        lower, upper = self.bounds
        near = _ON_BOUND * self.scales
        above = np.where(theta >= upper - near, 1, 0)
        return np.where(theta <= lower + near, -1, above).astype(np.int64)

    def all_values(self, theta: FloatArray) -> FloatArray:
        """The model's whole parameter vector with the free ones at ``theta``, shape (n_p,)."""
        p = self.model.parameters.values
        order = self.model.parameters.names
        for value, name in zip(theta, self.names, strict=True):
            p[order.index(name)] = value
        return p


def with_values(model: Model, values: Mapping[str, float]) -> Model:
    """The same model with other values of some parameters, also in the models beneath it."""
    changed = copy.copy(model)
    beneath = getattr(model, "base", None)
    if isinstance(beneath, Model):
        changed.base = with_values(beneath, values)  # type: ignore[attr-defined]
    changed.parameters = ParameterSet(
        (
            replace(parameter, value=float(values.get(parameter.name, parameter.value)))
            for parameter in model.parameters
        ),
        model.parameters.name,
    )
    return changed


def acting_parameters(model: Model) -> set[str]:
    """Names of the parameters on which the model's step or its outputs depend at all.

    A locked axis or a prescribed rotor leaves others without any part in the equations.
    """
    discrete = discretise(model, model.sample_time or _ANY_STEP, 1)
    acting = set[str]()
    for function in (discrete.step, discrete.measurement):
        columns = function.jac_sparsity(0, function.index_in("p")).get_triplet()[1]
        acting |= {model.parameters.names[column] for column in columns}
    return acting


class FitOutcome(Enum):
    """How a fit ended; the value is the sentence for the user."""

    CONVERGED = "converged"
    BUDGET_SPENT = "the budget was spent before the search settled: the best so far is kept"
    INTERRUPTED = "interrupted: the best so far is kept"
    STUCK = "no step lowers the cost, though its slope is not zero: look at the starts and scales"
    FAILED = "no start could be simulated: look at the parameters, the units and the time step"

    @property
    def settled(self) -> bool:
        """Whether the result is what the method was after."""
        return self is FitOutcome.CONVERGED


class HistoryPoint(NamedTuple):
    """The search at one moment."""

    evaluations: int  #: simulations of all recordings so far
    seconds: float  #: since the fit began
    #: Of the point where it was, or of the best of a population. It may rise: a new search begins,
    #: residuals are weighed anew (multiple shooting), a training step fails.
    cost: float


@dataclass(frozen=True, kw_only=True)
class FitResult:
    """What a fit found."""

    method: str
    outcome: FitOutcome
    #: At the end: half the sum of squared whitened residuals, robust and with the priors, for
    #: parameters of equations; a network's own training loss
    cost: float
    #: The free parameters by name, in the order of ``covariance``
    values: Mapping[str, float] = field(default_factory=dict)
    covariance: FloatArray | None = None  #: (n_f, n_f) array or None
    history: Sequence[HistoryPoint] = ()
    evaluations: int = 0
    seconds: float = 0.0  #: s, that the fit took
    #: A model that is not a parameter set (a network), as the content of a model file
    model_document: Mapping[str, Any] | None = None
    #: What the method made of the problem's model besides the values, of any model with the same
    #: one beneath; None: nothing
    remodel: Callable[[Model], Model] | None = None
    details: Mapping[str, Any] = field(default_factory=dict)  #: What else there is to tell, as JSON

    @property
    def theta(self) -> FloatArray:
        """The values as a vector, shape (n_f,)."""
        return np.array(list(self.values.values()), dtype=float)


class Progress(Protocol):
    """Who watches a fit. A method calls it a few times a second at most a few microseconds each."""

    def update(self, fraction: float, cost: float, message: str) -> bool:
        """Tell how far it is; False asks to stop with the best so far.

        ``fraction``: of the work, 0 to 1. ``cost``: as in :class:`HistoryPoint`. ``message``: one
        line.
        """

    def save(self, state: Mapping[str, Any]) -> None:
        """Keep what the method needs to go on after an interruption, as JSON has it."""

    def saved(self) -> Mapping[str, Any] | None:
        """What was kept by an interrupted fit of the same problem; None: begin."""


class SilentProgress:
    """A progress that shows nothing, never stops and resumes nothing."""

    def update(self, fraction: float, cost: float, message: str) -> bool:
        return True

    def save(self, state: Mapping[str, Any]) -> None:
        pass

    def saved(self) -> Mapping[str, Any] | None:
        return None


@runtime_checkable
class Method(Protocol):
    """A method of identification: a frozen dataclass of its settings."""

    #: Whether it fits the problem's free parameters; False: it trains a model of its own.
    fits_parameters: ClassVar[bool]

    def fit(self, problem: FitProblem, progress: Progress) -> FitResult:
        """Fit the problem. The same problem, settings and seed give the same result.

        Raises RecordingError if the recordings cannot be fitted; it says what to record instead.
        """
