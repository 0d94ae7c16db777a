"""Fits in the metric of innovations: the cost of a misfit that the equations' own error excuses."""
