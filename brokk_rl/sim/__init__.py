"""Simulated world: machine, drive and block with a borehole, on CPU threads or on a GPU."""
