"""Excitations: commands for recordings from which an actuator is identified and diagnosed.

Numpy only: they also run on the machine's own computer. What each separates is said in its YAML
file.
"""
