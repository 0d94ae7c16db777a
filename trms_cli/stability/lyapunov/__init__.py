"""Lyapunov functions of the rig at constant commands, and proofs over boxes of states."""
