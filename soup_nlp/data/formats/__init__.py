"""Readers of image, flow, depth and camera files.

Every reader raises `DataError` for a file that is missing, truncated or of another format.
"""
