"""The same as `trackmdp replay`."""

import sys

from trackmdp.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["replay", *sys.argv[1:]]))
