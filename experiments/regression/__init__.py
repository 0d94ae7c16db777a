"""Tracking errors of a small matrix of runs, held against a recorded baseline."""
