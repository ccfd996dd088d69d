"""Metrics, baselines, scores, and a referee that recomputes stored results."""
