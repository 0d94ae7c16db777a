"""One axis and two axes, by Newton and by Lagrange, on the same commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.chapter2.simulation import Difference, FloatArray, OpenLoop, Response, difference
from experiments.chapter2.study import Study, signal, times
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.newtonian import Newtonian

ANGLES = ("alpha_v", "alpha_h")
_PERIODS, _LEAST = 3.0, 20.0  # of a case with one axis; s


@dataclass(frozen=True)
class Comparison:
    """One case by both models."""

    name: str
    why: str  #: What it is there for, or its signal in words
    newtonian: Response
    lagrangian: Response
    differences: dict[str, Difference]  #: Of the Newtonian from the Lagrangian model, by output


def _compared(name: str, why: str, newtonian: Response, lagrangian: Response) -> Comparison:
    return Comparison(
        name,
        why,
        newtonian,
        lagrangian,
        {
            output: difference(newtonian.outputs[output], values)
            for output, values in lagrangian.outputs.items()
        },
    )


def one_axis(study: Study, freedom: str) -> list[Comparison]:
    """The thesis's cases with one axis: ``vertical`` or ``horizontal``."""
    T = study.sample_time
    both = [
        OpenLoop(kind(freedom=freedom), T, study.substeps)  # type: ignore[arg-type]
        for kind in (Newtonian, Lagrangian)
    ]
    start = rest_of(both[1])
    comparisons = []
    for shape, cases in study.one_axis[freedom].items():
        for frequency, amplitude in cases:
            wave = signal(
                {"signal": shape, "frequency": frequency, "amplitude": amplitude}, freedom
            )
            t = times(max(_LEAST, _PERIODS / frequency), T)
            u = wave.sample(t)[:, None]
            name = f"{shape} {frequency:g} Hz, {amplitude:g} V"
            comparisons.append(_compared(name, "", *(model.respond(u, start) for model in both)))
    return comparisons


def pair_of_commands(study: Study, name: str) -> FloatArray:
    """(n, 2) V."""
    pair = study.two_axes[name]
    t = times(pair.duration, study.sample_time)
    waves = [signal(pair.u_v, f"two_axes.{name}.u_v"), signal(pair.u_h, f"two_axes.{name}.u_h")]
    return np.stack([wave.sample(t) for wave in waves], axis=-1)


def two_axes(study: Study) -> list[Comparison]:
    """The nine cases."""
    T = study.sample_time
    # Designed to stay off the stops: contact would hide what is compared.
    both = [OpenLoop(kind(), T, study.substeps, stops=False) for kind in (Newtonian, Lagrangian)]
    start = rest_of(both[1])
    return [
        _compared(
            name, pair.why, *(model.respond(pair_of_commands(study, name), start) for model in both)
        )
        for name, pair in study.two_axes.items()
    ]


def rest_of(loop: OpenLoop) -> dict[str, float]:
    """Angles at rest, for all models to start from."""
    model = loop.model
    return {a: float(model.rest()[model.state_index(a)]) for a in ANGLES if a in model.state_names}
