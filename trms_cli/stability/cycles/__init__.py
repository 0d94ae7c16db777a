"""Periodic motions: found, closed by Newton's method, judged by Floquet multipliers, predicted."""
