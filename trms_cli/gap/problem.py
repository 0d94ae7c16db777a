"""What is to be diagnosed: a model, recordings of one rig, and the effects that are suspected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from trms_cli.effects.effect import Effect
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model

Effort = Literal["quick", "normal", "thorough"]

#: s. Lengths of the free runs that the gap is told at.
HORIZONS = (0.1, 0.5, 2.0, 10.0)


@dataclass(frozen=True, kw_only=True)
class GapProblem:
    """A model, recordings of one rig, candidates."""

    model: Model  #: The nominal model, with the effects that it has already
    model_name: str  #: As the user named it
    #: Whole recordings with one sample time; they measure some or all of the model's outputs
    datasets: tuple[Dataset, ...]
    #: The library: effects that may be the cause, by name, at their typical sizes
    candidates: Mapping[str, Effect]
    #: s, of the blocks that are fitted, compared and resampled
    block: Annotated[float, Meta(gt=0)] = 10.0
    #: Share of the recordings that nothing is chosen on and the shrink is measured on
    sealed_share: Annotated[float, Meta(gt=0, lt=1)] = 0.25
    effort: Effort = "normal"
    seed: Annotated[int, Meta(ge=0)] = 0
    jobs: Annotated[int, Meta(ge=1)] = 2
    warnings: tuple[str, ...] = field(default=())  #: Of the admission, to stand in the report
