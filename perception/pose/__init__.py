"""Pose of a borehole from an ellipse, depth and camera."""
