"""Chirps: one input sweeps up while the other sweeps down."""

from dataclasses import dataclass

from trms_cli.identification.excitation.excitation import Plan, Shape, check_band, shape_of
from trms_cli.references.chirp import Chirp


@dataclass(frozen=True, kw_only=True)
class ChirpExcitation:
    """A sine whose frequency sweeps over the band by equal factors in equal times."""

    upwards: bool = True  #: Whether the first input begins with the lowest frequency

    def shape(self, plan: Plan) -> Shape:
        """The signals; see :class:`Excitation`."""
        check_band(plan)
        signals = []
        for i in range(plan.inputs):
            up = self.upwards == (i % 2 == 0)
            first, last = (plan.lowest, plan.highest) if up else (plan.highest, plan.lowest)
            chirp = Chirp(
                amplitude=1.0,
                frequency=first,
                final_frequency=last,
                duration=plan.duration,
                sweep="logarithmic",
            )
            signals.append(chirp.sample(plan.time))
        return shape_of(signals)
