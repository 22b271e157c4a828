"""The loop: separate processes for bus, policy and log, what they share, and how they keep time."""
