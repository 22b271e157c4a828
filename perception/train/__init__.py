"""Training of the segmenting network."""
