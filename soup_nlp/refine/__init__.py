"""Discrete refinement: particles and TRW-S."""
