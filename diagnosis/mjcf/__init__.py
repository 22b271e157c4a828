"""MJCF files: as the plant of a diagnosis, and changed by its findings. The only door of MuJoCo in this room."""
