"""Real solvers on the same NLP: each in its own process, every claim verified."""
