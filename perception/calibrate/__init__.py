"""Camera extrinsics: from a board on the arm, two pose logs or touched points."""
