"""Cameras, planes, rotations, superpixels, graphs and the soup: pure numpy."""
