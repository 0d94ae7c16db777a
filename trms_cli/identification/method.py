"""What a method of identification is: problem in, fitted model out, on the way interruptible."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.problem import FitProblem


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
    #: What else there is to tell, as JSON has it
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def theta(self) -> FloatArray:
        """The values as a vector, shape (n_f,)."""
        return np.array(list(self.values.values()), dtype=float)


class Progress(Protocol):
    """Who watches a fit. A method calls it a few times a second at most a few microseconds each."""

    def update(self, fraction: float, cost: float, message: str) -> bool:
        """Tell how far it is; False asks to stop with the best so far.

        Parameters
        ----------
        fraction : float
            Of the work, 0 to 1.
        cost : float
            As in :class:`HistoryPoint`.
        message : str
            One line.
        """

    def save(self, state: Mapping[str, Any]) -> None:
        """Keep what the method needs to go on after an interruption, as JSON has it."""

    def saved(self) -> Mapping[str, Any] | None:
        """What was kept by an interrupted fit of the same problem; None: begin."""


class Unwatched:
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
        """Fit the problem. The same problem, settings and seed give the same result."""
