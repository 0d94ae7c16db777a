"""The real rig without one: faults at the wire, in virtual and in real time."""
