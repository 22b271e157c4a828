"""The log: decoded signals and decisions as MCAP, raw frames as BLF, and what is made of them later."""
