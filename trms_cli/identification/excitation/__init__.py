"""Excitation design: signals that show a rig's dynamics, their band and amplitude from a model."""
