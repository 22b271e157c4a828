"""Tracking of one borehole over many frames."""
