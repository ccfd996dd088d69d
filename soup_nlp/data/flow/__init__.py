"""Sources of optical flow, its confidence, and what follows from it."""
