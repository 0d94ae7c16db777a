"""Equilibria, local stability, phase portraits, limit cycles, Lyapunov functions, loop margins."""
