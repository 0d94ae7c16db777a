"""A servo drive: the model and the driver."""
