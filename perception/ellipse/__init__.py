"""Ellipse detection in grey pictures."""
