"""Plugins of a user's own."""
