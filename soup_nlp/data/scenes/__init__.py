"""Rendered dynamic scenes with exact truth."""
