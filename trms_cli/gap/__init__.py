"""The gap between a rig and its model: where it lies, which effect causes it, how far it goes."""
