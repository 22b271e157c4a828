"""The operator's page: a server of its own between the loop and browsers."""
