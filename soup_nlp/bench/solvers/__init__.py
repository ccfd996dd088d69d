"""Comparison of solvers on the same NLP, each in a process of its own with verified claims."""
