"""Chapter 8: robust MPC by linear matrix inequalities."""
