"""The diagnosis by simulating every hypothesis, one module a step; see `docs/diagnosis.md`."""
