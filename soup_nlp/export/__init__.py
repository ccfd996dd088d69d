"""The NLP as a file for other solvers, and their answers read back."""
