"""Other people's solvers as controllers of the same closed loop, one a file."""
