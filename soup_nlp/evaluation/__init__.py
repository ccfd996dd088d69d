"""Metrics, baselines, scores, confidence, and the recomputation of stored results."""
