"""What to record next: the experiment that tells apart what these recordings could not."""

from __future__ import annotations

from trms_cli.gap.advice.advise import advise

__all__ = ["advise"]
