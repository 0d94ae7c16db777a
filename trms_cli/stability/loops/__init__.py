"""Closed loops around an operating point: their margins, and what they tolerate."""
