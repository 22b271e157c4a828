"""Protocols at the seams between rooms: one for each seam, the one that the framework calls."""
