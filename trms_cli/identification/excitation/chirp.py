"""Chirps: one input sweeps up while the other sweeps down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trms_cli.identification.excitation.excitation import (
    Plan,
    Shape,
    check_band,
    crest_factor,
    of_unit_peak,
)
from trms_cli.references.chirp import Chirp


@dataclass(frozen=True, kw_only=True)
class ChirpExcitation:
    """A sine whose frequency sweeps over the band by equal factors in equal times."""

    upwards: bool = True  #: Whether the first input begins with the lowest frequency

    def shape(self, plan: Plan) -> Shape:
        """The signals; see :class:`Excitation`."""
        check_band(plan)
        columns = []
        for i in range(plan.inputs):
            up = self.upwards == (i % 2 == 0)
            ends = (plan.lowest, plan.highest) if up else (plan.highest, plan.lowest)
            columns.append(
                Chirp(
                    amplitude=1.0,
                    frequency=ends[0],
                    final_frequency=ends[1],
                    duration=plan.duration,
                    sweep="logarithmic",
                ).sample(plan.time)
            )
        values = np.column_stack(columns)
        about = {"crest_factor": [crest_factor(column) for column in values.T]}
        return Shape(of_unit_peak(values), about)
