"""Benchmarks of finder and detectors against ground truth."""
