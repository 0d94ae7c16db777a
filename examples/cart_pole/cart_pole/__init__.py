"""A cart with a pendulum: the model and the driver."""
