"""Labels for real footage from a board in view, clicks and touched points."""
