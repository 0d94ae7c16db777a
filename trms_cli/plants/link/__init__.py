"""Rigs behind a wire: frames, what carries them, and both of its ends."""
