"""The compiled engine's own solver: a Riccati recursion over the horizon.

It is C beside the model's equations (``trms_cli/controllers/newton/riccati.c``), and its work grows
with the horizon, not with its cube. Where there is no compiler DAQP solves the same programs.
"""

from dataclasses import dataclass

from trms_cli.core.qp import Daqp


@dataclass(frozen=True, kw_only=True)
class Riccati(Daqp):
    """The engine's recursion; without a compiler DAQP."""
