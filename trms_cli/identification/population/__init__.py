"""Methods that try a population of parameter vectors at a time, and keep what they tried."""
