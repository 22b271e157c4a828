"""Deployment: what runs on the computer of the machine, without simulator or trainer."""
