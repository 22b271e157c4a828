"""Modes: what `brokk` does. Each is a spec with `run()`; the command composes and runs it."""
