"""Perception: from camera frames to the borehole in the base frame."""
