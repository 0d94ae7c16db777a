"""What is really there: a simulated rig, or a replayed recording."""
