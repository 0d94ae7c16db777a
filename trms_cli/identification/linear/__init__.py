"""Linear empirical models about an operating point: ARX, ARMAX, subspace."""
