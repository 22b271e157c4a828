"""The policy on the machine: its bundle, what it is told, and what it proposes to the operator's hands."""
