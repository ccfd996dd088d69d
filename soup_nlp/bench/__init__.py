"""Benchmarks: rows measured in separate processes, tables, plots, baseline and gate."""
