"""Sources of frames: folder, simulator, ZED and RealSense cameras, with validation."""
