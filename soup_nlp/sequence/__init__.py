"""Sequences: consecutive pairs solved and put on one scale."""
