"""Options of this package."""
