"""The same as `trackmdp evaluate`."""

import sys

from trackmdp.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["evaluate", *sys.argv[1:]]))
