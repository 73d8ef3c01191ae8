"""`python -m torchmembrane`: the same as the command `torchmembrane`."""

import sys

from .cli.main import main

if __name__ == "__main__":
    sys.exit(main())
