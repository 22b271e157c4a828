"""Modes of the machine's computer: `deploy`, `twin`, `bringup`, `recover`, `page`."""
