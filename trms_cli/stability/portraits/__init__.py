"""Phase portraits: trajectories, nullclines, rest points, separatrices in two or three states."""
