"""Pseudo-random binary sequences, the inputs shifted against each other.

L. Ljung, "System Identification", 2nd ed., section 13.3: the spectrum is flat up to about
0.44 over the time of a bit, and a sequence and its shift are uncorrelated but for one in its
length.
"""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from trms_cli.identification.excitation.excitation import Plan, Shape, check_band, shape_of
from trms_cli.references.prbs import Prbs

#: The spectrum is flat up to this over the time of a bit.
FLAT = 0.44
_MOST_BITS = 16


@dataclass(frozen=True, kw_only=True)
class PrbsExcitation:
    """Two levels; the time of a bit from the band's upper end, the length from its lower end."""

    #: Length of the shift register; None: so long that the sequence repeats at ``lowest``, but not
    #: longer than the excitation where that is possible
    bits: Annotated[int, Meta(ge=2, le=16)] | None = None

    def shape(self, plan: Plan) -> Shape:
        """The signals; see :class:`Excitation`."""
        check_band(plan)
        hold = max(1, round(FLAT / plan.highest / plan.sample_time)) * plan.sample_time
        bits = self.bits
        if bits is None:
            bits = 2
            while (2**bits - 1) * hold < 1 / plan.lowest and bits < _MOST_BITS:
                bits += 1
        signals = [
            Prbs(amplitude=1.0, hold=hold, bits=bits, phase=i / plan.inputs).sample(plan.time)
            for i in range(plan.inputs)
        ]
        return shape_of(signals, bit_s=hold, bits=bits, period_s=(2**bits - 1) * hold)
