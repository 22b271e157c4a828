"""Recording: decoded signals and decisions as MCAP, and their conversion."""
