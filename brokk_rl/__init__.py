"""brokk_rl: learning control for heavy hydraulic machines."""

__version__ = "0.1.0"
