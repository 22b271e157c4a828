"""The processes of the loop, the memory that they share, and their timing."""
