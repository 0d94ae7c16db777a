"""A run that a sweep is to make, and what came of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

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
