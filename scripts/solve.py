"""The same as `trackmdp solve`."""

import sys

from trackmdp.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["solve", *sys.argv[1:]]))
