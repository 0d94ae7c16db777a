"""What the rig is asked to follow: signals, one file each, and their shaping."""
