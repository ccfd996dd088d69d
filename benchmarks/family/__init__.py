"""The SOUP family: a named, versioned set of NLPs for people who write solvers."""
