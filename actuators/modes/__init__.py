"""Modes of recordings and models: `collect`, `convert`, `inspect`, `identify`."""
