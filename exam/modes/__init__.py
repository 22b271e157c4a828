"""The mode of the exam."""
