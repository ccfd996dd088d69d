"""From a problem to a run: prepare, solve, refine, evaluate."""
