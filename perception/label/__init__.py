"""Labels for real footage from a board, clicks and touched points."""
