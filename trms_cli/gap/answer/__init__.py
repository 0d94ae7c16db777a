"""From what raced to what is said: beliefs, the verdict, how far the gap shrinks, the wording."""

from __future__ import annotations

from trms_cli.gap.answer.belief import Believed, believe
from trms_cli.gap.answer.far import Far, how_far
from trms_cli.gap.answer.telling import told

__all__ = ["Believed", "Far", "believe", "how_far", "told"]
