"""Identification: fits of actuator models, scores of their free runs, verdict and report."""
