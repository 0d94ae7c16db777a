"""What a controller or an observer believes about the rig."""
