"""Modes of perception: `perceive`, `render`, `train_perception`, `label`, `calibrate`, `board`."""
