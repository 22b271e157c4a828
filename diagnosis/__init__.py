"""Where the gap between simulator and machine lies, which effect causes it, and how far the effect closes it."""
