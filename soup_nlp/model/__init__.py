"""The energy as a nonlinear program: kernels, tables, assembly, and the numpy oracle."""
