"""Excitations: commands for recordings from which an actuator is identified and diagnosed.

Numpy only: they also run on the machine's own computer. The YAML file of each excitation says which
effects it separates.
"""
