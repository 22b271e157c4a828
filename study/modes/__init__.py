"""`brokk mode=study`."""
