"""The parts of robust MPC: polytope, linear matrix inequalities, certificate, coordinates."""
