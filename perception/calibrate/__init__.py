"""Camera extrinsics from a board on the arm."""
