"""What a sweep varies: choices between values, ranges of numbers, priors of parameters."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Choice:
    """A key with several values, each tried: ``controller=pid,lqr``, ``seed=range(5)``."""

    key: str
    values: tuple[str, ...]  #: As they would be typed for one run


@dataclass(frozen=True)
class Range:
    """A number between two bounds: ``controller.weights.u_v=interval(0.1,10)``."""

    key: str
    low: float  #: In the unit of the key
    high: float  #: both are allowed values
    logarithmic: bool = False  #: Equal ratios count alike: ``tag(log,interval(0.1,10))``
    #: Whole numbers only: both bounds were typed without a point, and the key does not hold a
    #: fraction by default
    whole: bool = False
    now: float | None = None  #: The key's value without the sweep; None where it has none


@dataclass(frozen=True)
class PriorOfKey:
    """A parameter with the distribution that its table states: ``plant.parameters.k_g=prior``."""

    key: str
    mean: float  #: The value in the table, in the parameter's unit
    sd: float  #: Standard deviation of the prior, in the same unit
    low: float  #: Bounds within which a draw must lie
    high: float  #: Bounds within which a draw must lie


@dataclass(frozen=True)
class Space:
    """All that a sweep varies, and what all of its runs share."""

    fixed: tuple[str, ...]  #: Overrides of every run
    choices: tuple[Choice, ...]  #: In the order typed; the last varies fastest, as in nested loops
    continuous: tuple[Range | PriorOfKey, ...] = ()  #: Empty for a grid
