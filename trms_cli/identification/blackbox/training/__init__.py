"""The training algorithms: one family a file, one configuration a member (configs/training)."""
