"""The Newton MPC: its problem, its engine in C, and the same in NumPy without a compiler."""
