"""A cart with a pendulum: one force, two positions, unstable upright."""
