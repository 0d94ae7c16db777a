"""What a sweep varies (choices, ranges, priors of parameters), its points and what came of them."""

from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal


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


#: ``lost``: its worker died each time that it was tried.
State = Literal["done", "failed", "interrupted", "lost"]


@dataclass(frozen=True)
class SweepPoint:
    """One run of a sweep, before it is made."""

    number: int  #: From 0 on, without gaps; the name of its folder
    #: What would be typed for this run alone: ``("controller=pid", "plant.parameters.k_g=0.19")``
    overrides: tuple[str, ...]
    #: The value of each key that the sweep varies, as data: numbers for ranges and priors, text for
    #: choices
    values: Mapping[str, Any] = field(default_factory=dict)
    #: The proposal of an optimiser that it belongs to: several points where a proposal is tried
    #: under several conditions. None: the sampler searches for nothing.
    trial: int | None = None


class PackedFigures(Mapping[str, float]):
    """Figures of one of many results: the names are kept once, the values as plain numbers."""

    __slots__ = ("_names", "_values")
    _known: ClassVar[dict[tuple[str, ...], dict[str, int]]] = {}

    def __init__(self, figures: Mapping[str, float]) -> None:
        names = tuple(figures)
        known = self._known.get(names)
        if known is None:
            known = self._known.setdefault(names, {name: i for i, name in enumerate(names)})
        self._names = known
        self._values = array("d", figures.values())

    def __getitem__(self, name: str) -> float:
        return self._values[self._names[name]]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __repr__(self) -> str:
        return repr(dict(self))


@dataclass(frozen=True)
class RunResult:
    """What came of a point."""

    number: int  #: Of the point
    state: State
    #: Figures of its score by the names that ``trms runs`` has for them (``rmse_yaw``, ``effort``,
    #: …), SI units; what is not finite is left out
    figures: Mapping[str, float] = field(default_factory=dict)
    #: What the command itself calls its figure of merit (smaller is better), if it has one
    objective: float | None = None
    problem: str = ""  #: Why it failed
    notes: tuple[str, ...] = ()  #: Lines that the run would have told on standard error


_TABLE = "parameters"


def short_keys(keys: Sequence[str]) -> dict[str, str]:
    """The last two parts of each key, with as much before them as tells it from the others.

    ``controller.state_weights.alpha_v`` becomes ``state_weights.alpha_v``; of a parameter, as
    ``plant.parameters.k_g``, the name is enough.
    """
    split = {key: key.split(".") for key in keys}
    short = {}
    for key, parts in split.items():
        size = 1 if parts[-2:-1] == [_TABLE] else 2
        while size < len(parts) and any(
            other != key and others[-size:] == parts[-size:] for other, others in split.items()
        ):
            size += 1
        short[key] = ".".join(parts[-size:])
    return short
