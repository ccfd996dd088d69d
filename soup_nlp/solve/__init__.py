"""Ipopt stages and residuals recomputed from raw data."""
