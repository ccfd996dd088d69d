"""Readers of image, flow, depth and camera files."""
