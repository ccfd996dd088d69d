"""Sources of optical flow, its confidence and correction, and superpixel borders along it."""
