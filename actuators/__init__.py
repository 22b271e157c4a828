"""Actuator models: from valve commands and joint history to the next joint position."""
