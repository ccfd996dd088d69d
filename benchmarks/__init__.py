"""Benchmarks: pairs with truth, their scores, and the tables and pictures under results/.

    python -m benchmarks accuracy --suite rendered --suite shared --data DIR --flow dis
    python -m benchmarks compare results/accuracy out/bench/accuracy

Install with `pip install -e '.[bench]'`; every command has `--help`.
"""

import benchmarks.everyday  # noqa: F401, makes its scenes known
