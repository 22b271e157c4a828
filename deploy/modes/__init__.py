"""Modes of the machine's computer: `deploy`, `twin`, `bringup`, `page`."""
