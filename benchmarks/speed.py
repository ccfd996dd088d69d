"""Seconds, growth and energy against the yardstick: `soup-nlp bench speed` under its other name.

python benchmarks/speed.py [--quick] [--sizes 250,500] ...
python benchmarks/speed.py --check benchmarks/speed_baseline.json
"""

from __future__ import annotations

import sys

from soup_nlp.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["bench", "speed", *sys.argv[1:]]))
