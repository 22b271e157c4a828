"""Sources of frames: a folder, the simulator, a ZED or RealSense camera; each refuses by name what nothing can be made of."""
