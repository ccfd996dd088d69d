"""Discrete refinement: particles, chosen by TRW-S."""
