"""Superpixel Soup as a nonlinear program: dense 3D of a dynamic scene from two frames."""

__version__ = "0.1.0"
