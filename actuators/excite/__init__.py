"""Excitations: commands that show what an actuator does, for collecting the recordings it is identified and diagnosed from.

Numpy only: they also run on the machine's own computer. What each separates is said in its YAML
file.
"""
