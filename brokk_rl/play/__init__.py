"""Playing: simulated machines that a person watches and touches while they run."""
