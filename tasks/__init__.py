"""Tasks: goals of the machine, criteria of success, rewards."""
