"""The same as `trackmdp export`."""

import sys

from trackmdp.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["export", *sys.argv[1:]]))
