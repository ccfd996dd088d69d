"""Benchmarks: studies over pairs and options, their tables and plots, comparison of solvers."""

from importlib.util import find_spec

from soup_nlp.errors import ConfigError

if find_spec("pandas") is None:
    raise ConfigError(
        "benchmarks need pandas", where="soup-nlp bench", hint="pip install 'soup-nlp[bench]'"
    )
