"""Modes of the diagnosis: `diagnose`, `close_gap`, `rehearse`."""
