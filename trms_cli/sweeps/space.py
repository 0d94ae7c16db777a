"""What a sweep varies: choices between values, ranges of numbers, priors of parameters."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Choice:
    """A key with several values, each tried with each: ``controller=pid,lqr``, ``seed=range(5)``.

    Attributes
    ----------
    key : str
    values : tuple of str
        As they would be typed for one run.
    """

    key: str
    values: tuple[str, ...]


@dataclass(frozen=True)
class Range:
    """A number between two bounds: ``controller.weights.u_v=interval(0.1,10)``.

    Attributes
    ----------
    key : str
    low, high : float
        In the unit of the key; both are allowed values.
    logarithmic : bool
        Equal ratios count alike: ``tag(log,interval(0.1,10))``.
    whole : bool
        Whole numbers only: both bounds were typed without a point, and the key does not hold a
        fraction by default.
    now : float or None
        The key's value without the sweep; None where it has none.
    """

    key: str
    low: float
    high: float
    logarithmic: bool = False
    whole: bool = False
    now: float | None = None


@dataclass(frozen=True)
class Prior:
    """A parameter with the distribution that its table states: ``plant.parameters.k_g=prior``.

    Attributes
    ----------
    key : str
    mean : float
        The value in the table, in the parameter's unit.
    sd : float
        Standard deviation of the prior, in the same unit.
    low, high : float
        Bounds within which a draw must lie.
    """

    key: str
    mean: float
    sd: float
    low: float
    high: float


@dataclass(frozen=True)
class Space:
    """All that a sweep varies, and what all of its runs share.

    Attributes
    ----------
    fixed : tuple of str
        Overrides of every run.
    choices : tuple of Choice
        In the order typed; the last varies fastest, as in nested loops.
    continuous : tuple of Range or Prior
        Empty for a grid.
    """

    fixed: tuple[str, ...]
    choices: tuple[Choice, ...]
    continuous: tuple[Range | Prior, ...] = ()
