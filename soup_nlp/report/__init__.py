"""Metrics, pictures, point clouds and the result folder."""
