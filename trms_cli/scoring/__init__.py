"""How well a run went: metrics, and comparison with a baseline."""
