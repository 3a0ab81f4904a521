"""`python -m trackmdp train` is `trackmdp train`."""

from __future__ import annotations

import sys

from trackmdp.app.cli import main

if __name__ == "__main__":
    sys.exit(main())
