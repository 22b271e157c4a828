"""Mounts that carry a camera, and the choice of their next view."""
