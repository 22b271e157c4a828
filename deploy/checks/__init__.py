"""Checks beside the kernel, each of which can be switched off by itself: space and motion of the arm."""
