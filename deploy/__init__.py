"""Deployment: the programs on the computer of the machine, without simulator or trainer."""
