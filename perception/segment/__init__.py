"""Segmenters: which pixels show the block and the inside of its holes."""
