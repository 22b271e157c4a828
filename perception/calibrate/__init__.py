"""Where the camera is in the base frame: from a board on the arm or from touched points, stored with its uncertainty."""
