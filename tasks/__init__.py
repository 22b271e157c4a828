"""Tasks: what the machine is asked to do, what counts as done, and what is rewarded on the way."""
