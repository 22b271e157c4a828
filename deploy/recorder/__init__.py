"""Recording: decoded signals and decisions as MCAP, raw frames as BLF, and their conversion."""
