"""Modes of the diagnosis: `diagnose`, `rehearse`, `why`."""
