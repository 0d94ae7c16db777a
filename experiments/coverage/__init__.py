"""Do the intervals of a grey-box fit hold what they promise? Counted over many simulated rigs."""
