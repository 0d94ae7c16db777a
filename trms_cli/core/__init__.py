"""What every room stands on: errors, plugins from configuration, compiled functions."""
