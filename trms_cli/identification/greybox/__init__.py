"""Fitting the parameters of equations by simulation: windows, least squares, statistics."""
