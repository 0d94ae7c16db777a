"""The gap, online: what changes on a rig is noticed while it runs; see :mod:`.gap_watch`."""
