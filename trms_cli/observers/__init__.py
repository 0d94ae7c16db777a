"""State estimators."""
