"""Residuals of simulations, made white by a Kalman filter that lets the equations err a little."""
