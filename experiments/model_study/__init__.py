"""Which model is best for control: white, grey, black and linear ones on the same rigs."""
