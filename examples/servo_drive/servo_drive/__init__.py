"""A servo drive: one force, one position."""
