"""Reinforcement learning: the only place that knows rsl-rl and the trackers."""
