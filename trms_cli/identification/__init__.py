"""Fitting models to recordings, judging them on recordings, and designing what to record."""
