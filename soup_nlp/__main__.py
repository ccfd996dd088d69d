"""`python -m soup_nlp` is `soup-nlp`."""

import sys

from soup_nlp.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
