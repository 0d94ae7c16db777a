"""The program from Python: what the commands do, called with plain arguments and given objects."""
