"""Parts of our own for brokk_rl."""
