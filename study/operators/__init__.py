"""Simulated operators: for tests of the study and for its design, never instead of people; seeded."""
