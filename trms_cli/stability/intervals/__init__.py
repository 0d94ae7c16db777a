"""Interval arithmetic on the equations of a model: statements that hold everywhere in a box."""
