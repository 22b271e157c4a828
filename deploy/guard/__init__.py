"""The guard between a proposed command and the valves."""
