"""Actuator models: next joint positions from the history of commands and positions."""
