"""A run that a sweep is to make, and what came of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

#: ``lost``: its worker died each time that it was tried.
State = Literal["done", "failed", "interrupted", "lost"]


@dataclass(frozen=True)
class Point:
    """One run of a sweep, before it is made.

    Attributes
    ----------
    number : int
        From 0 on, without gaps; the name of its folder.
    overrides : tuple of str
        What would be typed for this run alone: ``("controller=pid", "plant.parameters.k_g=0.19")``.
    values : dict
        The value of each key that the sweep varies, as data: numbers for ranges and priors, text
        for choices.
    trial : int or None
        The proposal of an optimiser that it belongs to: several points where a proposal is tried
        under several conditions. None: the sampler searches for nothing.
    """

    number: int
    overrides: tuple[str, ...]
    values: Mapping[str, Any] = field(default_factory=dict)
    trial: int | None = None


@dataclass(frozen=True)
class Result:
    """What came of a point.

    Attributes
    ----------
    number : int
        Of the point.
    state : {"done", "failed", "interrupted", "lost"}
    figures : dict of str to float
        Figures of its score by the names that ``trms runs`` has for them (``rmse_yaw``,
        ``effort``, …), SI units; what is not finite is left out.
    objective : float or None
        What the command itself calls its figure of merit (smaller is better), if it has one.
    problem : str
        Why it failed.
    notes : tuple of str
        Lines that the run would have told on standard error.
    """

    number: int
    state: State
    figures: Mapping[str, float] = field(default_factory=dict)
    objective: float | None = None
    problem: str = ""
    notes: tuple[str, ...] = ()
