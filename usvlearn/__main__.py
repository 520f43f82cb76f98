"""`python -m usvlearn`: the command `usvlearn`, which does from any folder what train.py and evaluate.py do here."""

import sys

from usvlearn.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
