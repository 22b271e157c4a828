"""The registries: one folder a group, one YAML an entry. This package only makes them installable."""
