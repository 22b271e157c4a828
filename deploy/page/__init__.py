"""The operator's page: a server of its own that shows the newest state of the loop in a browser and takes few wishes back."""
