"""Benchmarks as a command: runs in processes of their own, tables, plots, baseline and gate."""
