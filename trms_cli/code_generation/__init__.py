"""Controllers as C source for a rig's own computer."""
