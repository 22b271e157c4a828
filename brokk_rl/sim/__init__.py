"""The simulated world: machine, drive, block with borehole; stepped by MuJoCo on threads (`native`) or on a GPU (`warp`)."""
