"""What a missing force looks like: where and when it acts, what it depends on, what it is like."""
