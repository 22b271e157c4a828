"""Recordings: look at them, import them from other formats."""
