"""Benchmarks: studies over pairs and options, their tables and plots, comparison of solvers."""

from importlib.util import find_spec

from soup_nlp.errors import ConfigError

if not all(map(find_spec, ("pandas", "matplotlib", "optuna"))):
    raise ConfigError(
        "benchmarks need pandas, matplotlib and optuna", hint="pip install 'soup-nlp[bench]'"
    )
