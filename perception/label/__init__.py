"""Labels for real footage from a board in view and clicks."""
