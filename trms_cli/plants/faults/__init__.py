"""What breaks on a rig during a run: one file a kind of fault."""
