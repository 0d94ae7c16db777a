"""The gap between rig and model, closed: what a diagnosis is worth to a controller."""
